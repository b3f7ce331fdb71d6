import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.synthetic.scenes import texel_coordinates
from scan2albedo.synthetic.textures import skin, smooth_noise, spots, wood


@pytest.mark.parametrize("paint", [wood, skin])
def test_seeded_bounded_and_independent_of_resolution(paint):
    coarse, fine = texel_coordinates(40), texel_coordinates(120)
    first = paint(coarse, np.random.default_rng(7))
    assert first.shape == (1600, 3)
    assert first.min() > 0
    assert first.max() < 1
    assert_array_equal(first, paint(coarse, np.random.default_rng(7)))
    assert not np.allclose(first, paint(coarse, np.random.default_rng(8)))
    same_places = paint(fine, np.random.default_rng(7)).reshape(120, 120, 3)[1::3, 1::3]
    assert_allclose(first, same_places.reshape(-1, 3))


@pytest.mark.parametrize("paint", [wood, skin])
def test_grain_scales_the_pattern(paint):
    def roughness(grain):
        value = paint(texel_coordinates(256), np.random.default_rng(1), grain=grain).max(1).reshape(256, 256)
        return np.abs(np.diff(value, axis=1)).mean() / value.std()

    assert roughness(3.0) < 0.6 * roughness(1.0)


def test_skin_is_reddish_and_darkens_with_tone():
    uv = texel_coordinates(64)
    means = [skin(uv, np.random.default_rng(0), tone=t).mean(0) for t in (0.0, 0.5, 1.0)]
    assert all(r > g > b for r, g, b in means)
    assert means[0][0] > means[1][0] > means[2][0]


def test_noise_has_the_asked_number_of_bumps():
    rng = np.random.default_rng(0)
    line = np.column_stack([np.linspace(0, 1, 20000), np.full(20000, 0.3)])
    crossings = np.mean([np.sum(np.diff(np.sign(smooth_noise(line, (50, 9), rng))) != 0) for _ in range(20)])
    assert 25 < crossings < 75
    field = [smooth_noise(texel_coordinates(50), (30, 30), rng).std() for _ in range(10)]
    assert np.mean(field) == pytest.approx(1.0, abs=0.15)


def test_spots_are_discs_of_their_radius():
    value = spots(texel_coordinates(400), np.random.default_rng(3), count=30, radius=(0.01, 0.01))
    assert value.max() == 1
    assert value.min() == 0
    area = np.mean(value > 0.5)
    assert area == pytest.approx(30 * np.pi * 0.008**2, rel=0.25)
