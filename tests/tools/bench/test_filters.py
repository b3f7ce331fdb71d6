"""Filters against light: what they take away, and that pixels outside the mask do not matter."""

import numpy as np
import pytest
from bench.peers.filters import histogram_equalized, multi_scale_retinex
from numpy.testing import assert_allclose
from scipy.ndimage import gaussian_filter


@pytest.fixture
def albedo():
    """Smooth noise (128, 128) within [0.1, 0.9]."""
    field = gaussian_filter(np.random.default_rng(0).standard_normal((128, 128)), 2)
    return 0.1 + 0.8 * (field - field.min()) / np.ptp(field)


@pytest.mark.parametrize("normalize", [multi_scale_retinex, histogram_equalized])
def test_neither_the_strength_of_light_nor_what_lies_outside_the_mask_matters(
    normalize, albedo, face_like_mask
):
    other = 0.4 * np.where(face_like_mask, albedo, 0.9)
    result = normalize(other, face_like_mask)
    assert_allclose(result, normalize(albedo, face_like_mask), rtol=1e-9)
    assert (result[~face_like_mask] == 0).all()


def test_retinex_takes_smooth_light_away(albedo):
    light, mask = np.linspace(0.3, 1.0, 128), np.ones((128, 128), bool)
    left = multi_scale_retinex(albedo * light, mask) / multi_scale_retinex(albedo, mask)
    assert np.std(np.log(left)) < 0.35 * np.std(np.log(light))


def test_equalized_values_are_spread_evenly(albedo, face_like_mask):
    inside = histogram_equalized(albedo**3, face_like_mask)[face_like_mask]
    counts, _ = np.histogram(inside, bins=10, range=(0, 1))
    assert_allclose(counts / len(inside), 0.1, atol=2 / len(inside))
