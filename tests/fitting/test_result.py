"""How sure landmarks are: more where there is scan near them."""

import numpy as np
import pytest

from scan2albedo.fitting.result import landmark_deviation_mm


@pytest.fixture(scope="module")
def surface(model):
    vertices, _ = model.surface(2)
    return vertices, np.zeros(len(vertices))


def test_on_the_scan_it_is_what_is_usual_for_the_feature(model, surface):
    deviation = landmark_deviation_mm(model.landmarks, *surface)
    assert deviation.shape == (68,)
    assert deviation[31:36].max() < deviation[48:68].min()
    assert (deviation[:17] > 4).all()


def test_it_grows_where_there_is_no_scan_and_where_the_surface_lies_off_it(model, surface):
    vertices, residual = surface
    usual = landmark_deviation_mm(model.landmarks, vertices, residual)
    left = vertices[:, 0] > 0
    half = landmark_deviation_mm(model.landmarks, vertices, np.where(left, np.nan, residual))
    assert (half[[22, 26, 45, 54]] > usual[[22, 26, 45, 54]] + 1).all()
    np.testing.assert_array_equal(half[[17, 36, 48]], usual[[17, 36, 48]])
    off = landmark_deviation_mm(model.landmarks, vertices, residual + 3)
    np.testing.assert_allclose(off, np.hypot(usual, 3))


def test_a_surface_far_away_shows_nothing(model, surface):
    vertices, residual = surface
    far = landmark_deviation_mm(model.landmarks + 500, vertices, residual)
    assert (far > landmark_deviation_mm(model.landmarks, vertices, residual)).all()
