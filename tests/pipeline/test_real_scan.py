"""Real heads: landmarks against ones picked by hand, light of a whole head against that of its face."""

from dataclasses import replace

import numpy as np
import pytest

import scan2albedo as s2a
from scan2albedo.fitting import FitOptions
from scan2albedo.geometry.rigid import transform_points


def test_landmarks_and_surface_also_without_texture(shared_data):
    scan, model = s2a.load_scan(shared_data / "james.obj"), s2a.AnnotatedFaceModel.default()

    def found(scan, **options):
        return s2a.fit(scan, model, s2a.register(scan, model), **options)

    fitted = found(scan)
    picked = np.loadtxt(shared_data / "james_ibug68.csv", delimiter=",")
    error = np.linalg.norm(fitted.landmarks - transform_points(fitted.model_from_scan, picked), axis=1)
    assert error[17:].mean() < 3.5
    assert np.nanmean(fitted.residual_mm) < 0.2
    assert fitted.metrics["flipped_faces"] == 0
    again = found(replace(scan, texture_linear=None, uv=None))
    unseen = found(scan, options=FitOptions(colors=False))
    np.testing.assert_array_equal(again.landmarks, unseen.landmarks)
    assert abs(np.nanmean(again.residual_mm) - np.nanmean(fitted.residual_mm)) < 0.02


@pytest.mark.slow
def test_a_head_finds_the_lamp_that_a_face_finds(shared_data):
    faces = np.load(shared_data / "ict_faces.npz")
    shape = next(key for key in faces if key.startswith("shape_gener"))
    head = s2a.AnnotatedFaceModel.from_mesh(faces[shape], faces["faces"])
    scan = shared_data / "traced" / "p106_gloss.obj"
    of_head, of_face = (s2a.process(scan, model=m, size=256, quality="draft") for m in (head, "default"))
    image = of_head.geometry_image
    assert of_face.geometry_image.on_face is None
    assert 0.1 < image.on_face.sum() / image.mask.sum() < 0.3
    assert "are the face, where light is sought" in str(of_head.plan)
    lamp, other = (result.albedo.lights[0].direction for result in (of_head, of_face))
    assert np.degrees(np.arccos(lamp @ other)) < 5
