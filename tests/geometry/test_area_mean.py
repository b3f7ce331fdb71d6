"""Smaller images hold the means of the areas that their pixels cover."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from skimage.transform import resize_local_mean

from scan2albedo.geometry.rasterization import area_mean


def test_blocks_of_whole_pixels_are_averaged():
    image = np.random.default_rng(0).random((12, 8, 3))
    blocks = image.reshape(4, 3, 2, 4, 3).mean(axis=(1, 3))
    assert_allclose(area_mean(image, (4, 2)), blocks, atol=1e-14)
    assert_allclose(area_mean(image, (12, 8)), image, atol=1e-14)


@pytest.mark.parametrize(("size", "to"), [((30, 42), (19, 26)), ((100, 99), (26, 26)), ((5, 7), (5, 3))])
def test_pixels_that_are_covered_in_part_count_by_that_part(size, to):
    image = np.random.default_rng(1).random(size)
    assert_allclose(area_mean(image, to), resize_local_mean(image, to), atol=1e-12)


def test_half_of_a_mask_is_exactly_a_half():
    mask = np.arange(6) < 3
    assert (area_mean(np.tile(mask, (6, 1)), (1, 1)) == 0.5).all()
