"""A real scan, registered and fitted with no option, against landmarks picked by hand."""

from dataclasses import replace

import numpy as np
import pytest

import scan2albedo as s2a
from scan2albedo.fitting import FitOptions
from scan2albedo.geometry.rigid import transform_points


@pytest.fixture(scope="module")
def scan(shared_data):
    return s2a.load_scan(shared_data / "james.obj")


def found(scan, **options):
    model = s2a.AnnotatedFaceModel.default()
    return s2a.fit(scan, model, s2a.register(scan, model), **options)


@pytest.fixture(scope="module")
def fitted(scan):
    return found(scan)


def test_landmarks_and_surface(fitted, shared_data):
    picked = np.loadtxt(shared_data / "james_ibug68.csv", delimiter=",")
    error = np.linalg.norm(fitted.landmarks - transform_points(fitted.model_from_scan, picked), axis=1)
    assert error[17:].mean() < 3.5
    assert np.nanmean(fitted.residual_mm) < 0.2
    assert fitted.metrics["flipped_faces"] == 0


def test_the_geometry_needs_no_texture(scan, fitted):
    again = found(replace(scan, texture_linear=None, uv=None))
    unseen = found(scan, options=FitOptions(colors=False))
    np.testing.assert_array_equal(again.landmarks, unseen.landmarks)
    assert abs(np.nanmean(again.residual_mm) - np.nanmean(fitted.residual_mm)) < 0.02
