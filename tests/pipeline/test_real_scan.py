"""A real scan, registered and fitted with no option, against landmarks picked by hand."""

from dataclasses import replace

import numpy as np

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
