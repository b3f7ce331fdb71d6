"""White noise told from texture, in one channel and between channels."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, zoom

from scan2albedo.albedo.noise import additive_deviation, channel_noise, white_variance, window_mean

SIZE = 200
EVERYWHERE = np.ones((SIZE, SIZE), bool)


def _white_noise(rng, *channels):
    return rng.standard_normal((SIZE, SIZE, *channels))


def _smooth(rng, texels, deviation):
    field = gaussian_filter(_white_noise(rng), texels)
    return deviation * field / field.std()


@pytest.mark.parametrize("noise", [0.02, 0.06, 0.2])
def test_additive_noise_is_told_by_the_light(lit, noise, rng):
    albedo, light = lit
    value = albedo * light + noise * _white_noise(rng)
    assert additive_deviation(value, light, EVERYWHERE) == pytest.approx(noise, rel=0.15, abs=0.012)


def test_texture_alone_is_not_taken_for_additive_noise(lit):
    albedo, light = lit
    assert additive_deviation(albedo * light, light, EVERYWHERE) < 0.012
    assert additive_deviation(albedo, np.ones_like(light), EVERYWHERE) == 0


@pytest.mark.parametrize("noise", [0.01, 0.1])
def test_the_variance_of_white_noise_is_found_beside_smooth_texture(noise, rng):
    field = 1 + _smooth(rng, 3, 0.02) + noise * _white_noise(rng)
    found = white_variance(field[..., None], EVERYWHERE)
    # The least of several estimates falls short.
    assert 0.7 * noise**2 < np.median(found) < noise**2


def _spots(rng):
    field = np.ones((SIZE, SIZE))
    for row, column in rng.integers(5, SIZE - 5, (200, 2)):
        field[row : row + 3, column : column + 3] = 0.7
    return field


TEXTURES = {
    "smooth grain": lambda rng: 1 + _smooth(rng, 1, 0.05),
    "an edge": lambda rng: np.where(np.arange(SIZE) < 90, 0.4, 1.0) * np.ones((SIZE, 1)),
    "spots of three texels": _spots,
    "stripes of three texels' period": lambda rng: (
        1 + 0.2 * np.sin(np.arange(SIZE) * 2 * np.pi / 3) * np.ones((SIZE, 1))
    ),
    "noise enlarged by resampling": lambda rng: (
        1 + 0.05 * zoom(rng.standard_normal((SIZE // 2, SIZE // 2)), 2, order=1)
    ),
}


@pytest.mark.parametrize("kind", TEXTURES)
def test_texture_and_correlated_noise_are_not_white(kind, rng):
    field = TEXTURES[kind](rng)
    white = np.maximum(white_variance(field[..., None], EVERYWHERE), 0)
    # Means over the image: a window here and there finds some by chance.
    assert white.mean() < 0.03 * field.var()


def test_texels_that_are_not_usable_do_not_count(rng):
    field = 1 + 0.05 * _white_noise(rng)
    usable = rng.random((SIZE, SIZE)) > 0.3
    broken = np.where(usable, field, 100.0)
    assert 0.7 * 0.05**2 < np.median(white_variance(broken[..., None], usable)[usable, 0]) < 0.05**2
    assert np.all(white_variance(broken[..., None], np.zeros_like(usable)) == 0)


def test_fields_of_a_stack_do_not_touch_one_another(rng):
    fields = np.stack([_smooth(rng, 2, 0.1), 0.05 * _white_noise(rng), np.ones((SIZE, SIZE))])
    usable = rng.random((SIZE, SIZE)) > 0.2
    together = white_variance(np.moveaxis(fields, 0, -1), usable)
    for number, field in enumerate(fields):
        assert np.array_equal(white_variance(field[..., None], usable)[..., 0], together[..., number])


def test_means_over_a_window_are_the_same_for_a_field_and_its_channels(rng):
    fields, weight = rng.random((30, 40, 3)), (rng.random((30, 40)) > 0.5) * 1.0
    weight[:12, :12] = 0
    together = window_mean(fields, weight, 5)
    for c in range(3):
        assert together[..., c] == pytest.approx(window_mean(fields[..., c], weight, 5))
    around = np.s_[18:23, 28:33]
    assert together[20, 30, 1] == pytest.approx(np.average(fields[*around, 1], weights=weight[around]))
    assert (together[2, 2] == 0).all()


def _channels(relative):
    """Return the noise of a texture of some skin's colour under light of 1."""
    around = np.array([0.6, 0.42, 0.33]) * np.ones_like(relative)
    return channel_noise(relative, relative * around, around, np.ones_like(relative), EVERYWHERE)


@pytest.mark.parametrize(("shared", "own"), [(0.0, 0.03), (0.05, 0.015)])
def test_noise_of_each_channel_and_noise_that_they_nearly_share_is_found(shared, own, rng):
    noise = _channels(1 + shared * _white_noise(rng, 1) + own * _white_noise(rng, 3))
    assert noise.lead == 0
    assert np.median(noise.leading) == pytest.approx(shared**2 + own**2, rel=0.25)
    assert np.median(noise.chroma[..., 1]) == pytest.approx(2 * own**2, rel=0.15)
    assert np.all(noise.chroma[..., 0] == 0)


def test_white_texture_moves_all_channels_and_is_no_noise(rng):
    """Pores of one texel, in the colour of skin and stronger where it absorbs more, at 8 bits."""
    pores = 1 + 0.03 * _white_noise(rng, 1) * np.array([1.0, 1.0, 1.6])
    noise = _channels(pores)
    assert np.median(noise.leading) < 0.05 * 0.03**2
    assert np.median(noise.chroma[..., 2]) < 0.05 * 0.03**2


def test_stubble_is_no_noise_where_the_rest_of_the_picture_has_little(rng):
    """Dark dots of one texel on the lower third, under sensor noise."""
    dots = (rng.random((SIZE, SIZE)) < 0.2) & (np.arange(SIZE) > 130)[:, None]
    hair = np.where(dots[..., None], np.array([0.7, 0.75, 0.8]), 1.0)
    noise = _channels(hair * (1 + 0.01 * _white_noise(rng, 3)))
    assert np.median(noise.leading[150:]) < 0.3 * hair[150:, :, 0].var()


def test_grey_noise_is_told_by_the_light_alone(lit, rng):
    albedo, light = lit
    value = albedo * light + 0.06 * _white_noise(rng)
    grey = np.repeat(value[..., None], 3, 2)
    lights, around = light[..., None] * np.ones(3), np.full(grey.shape, 0.5)
    noise = channel_noise(grey / lights / around, grey, around, lights, EVERYWHERE)
    assert noise.leading == pytest.approx((0.06 / light / 0.5) ** 2, rel=0.35)
    assert not noise.chroma.any()
