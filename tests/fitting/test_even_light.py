"""Shading leaves a picture, what is painted stays."""

import numpy as np
import pytest

from scan2albedo.fitting.painted_features import without_shading
from scan2albedo.geometry.rasterization import FrontPicture

STEP_MM = 0.8
SIDE = 120


def ball(toward, paint):
    """A picture of a ball of 90 mm radius under a lamp, and its brightness."""
    x, y = np.meshgrid(*[np.linspace(-48, 48, SIDE)] * 2)
    depth = np.sqrt(90.0**2 - x**2 - y**2)
    normals = np.stack([x, y, depth], axis=-1) / 90
    brightness = paint * (0.1 + np.maximum(normals @ toward, 0))
    seen = x**2 + y**2 < 46**2
    color = np.repeat(brightness[..., None], 3, axis=-1)
    return FrontPicture(color, depth, seen, np.full(2, -48.0), STEP_MM), brightness


@pytest.mark.parametrize("toward", [(0, 0, 1), (0, 0.9, 0.4), (0.8, -0.3, 0.5)], ids=str)
def test_a_ball_of_one_colour_is_even(toward):
    picture, brightness = ball(toward, np.ones((SIDE, SIDE)))
    lit = brightness, without_shading(picture, brightness)
    before, after = (np.log(light[picture.seen]).std() for light in lit)
    assert after < max(0.35 * before, 0.02)


def test_a_dark_stripe_stays():
    paint = np.ones((SIDE, SIDE))
    paint[70:76] = 0.5
    picture, brightness = ball((0, 0.9, 0.4), paint)
    even = without_shading(picture, brightness)
    stripe = even[72, 40:80].mean() / even[[60, 86], 40:80].mean()
    assert 0.4 < stripe < 0.6


def test_hot_squares_and_unseen_ones_do_no_harm():
    picture, brightness = ball((0, 0.9, 0.4), np.ones((SIDE, SIDE)))
    hot = brightness.copy()
    hot[::16, ::16] = 1e6
    clean = without_shading(picture, brightness)
    change = np.abs(without_shading(picture, hot) - clean)
    assert change[picture.seen & (hot < 1e5)].max() < 0.05
    assert (clean[~picture.seen] == 0).all()
