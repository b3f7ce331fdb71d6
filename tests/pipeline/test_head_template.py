"""A template of a whole head: light is sought on the face, whatever lies beside it."""

import numpy as np
import pytest

from scan2albedo import AnnotatedFaceModel, process


@pytest.mark.slow
def test_a_head_finds_the_lamp_that_a_face_finds(shared_data):
    faces = np.load(shared_data / "ict_faces.npz")
    shape = next(key for key in faces if key.startswith("shape_gener"))
    head = AnnotatedFaceModel.from_mesh(faces[shape], faces["faces"])
    scan = shared_data / "traced" / "p106_gloss.obj"
    of_head, of_face = (process(scan, model=m, size=256, quality="draft") for m in (head, "default"))
    image = of_head.geometry_image
    assert of_face.geometry_image.on_face is None
    assert 0.1 < image.on_face.sum() / image.mask.sum() < 0.3
    assert "are the face, where light is sought" in str(of_head.plan)
    lamp, other = (result.albedo.lights[0].direction for result in (of_head, of_face))
    assert np.degrees(np.arccos(lamp @ other)) < 5
