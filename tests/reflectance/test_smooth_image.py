"""Smoothed look-ups: derivatives, gaps, borders."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.errors import ReflectanceError
from scan2albedo.reflectance.geometry_terms import SmoothImage

IMAGE = np.random.default_rng(0).uniform(size=(20, 30, 3))
PIXELS = np.random.default_rng(1).uniform([0, 0], [29, 19], size=(200, 2))


@pytest.mark.parametrize("blur", [0.0, 1.5])
def test_the_gradient_agrees_with_finite_differences(blur):
    image = SmoothImage(IMAGE, None, blur)
    h = 1e-7
    gradient = image.gradient(PIXELS)
    for axis in range(2):
        step = h * np.eye(2)[axis]
        expected = (image.look_up(PIXELS + step) - image.look_up(PIXELS - step)) / (2 * h)
        assert_allclose(gradient[:, :, axis], expected, atol=1e-6)


def test_without_blur_pixels_keep_their_colours_outside_nothing_is_covered_and_the_border_goes_on():
    image = SmoothImage(IMAGE, None, 0.0)
    outside = np.array([[-0.1, 3.0], [29.1, 3.0], [4.0, -5.0], [4.0, 19.5], [np.nan, np.nan]])
    assert not image.covers(outside).any()
    assert_array_equal(image.look_up(outside[2:3]), IMAGE[[0], [4]])
    assert (image.gradient(outside[:2])[:, :, 0] == 0).all()
    assert_array_equal(image.look_up(np.array([[0.0, 0], [29, 19], [7, 3]])), IMAGE[[0, 19, 3], [0, 29, 7]])


def test_gaps_are_filled_from_around_and_not_covered():
    spoilt, mask = np.full((20, 30, 3), 0.5), np.ones((20, 30), bool)
    spoilt[5, 5] = np.nan
    spoilt[6, 9, 1] = np.inf
    spoilt[10:, :] = 7.0
    mask[10:] = False
    image = SmoothImage(spoilt, mask, 1.0)
    assert_allclose(image.look_up(np.array([[5.0, 5], [9.2, 5.8], [3, 9.9]])), 0.5)
    covered = image.covers(np.array([[5.0, 5], [4.5, 5.5], [7, 5], [8.9, 5.9], [3, 8.9], [3, 9.1]]))
    assert covered.tolist() == [False, False, True, False, True, False]


def test_what_is_no_image_is_refused():
    for image, mask, kind, words in (
        (IMAGE[..., 0], None, ValueError, "image_linear"),
        (IMAGE, np.ones((20, 30)), ValueError, "mask"),
        (IMAGE, np.zeros((20, 30), bool), ReflectanceError, "no pixel"),
        (IMAGE * np.nan, None, ReflectanceError, "no pixel"),
    ):
        with pytest.raises(kind, match=words):
            SmoothImage(image, mask, 0.0)
