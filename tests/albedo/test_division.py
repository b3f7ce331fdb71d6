"""Division by the light: exact where it is known, noise drawn toward the neighbourhood, edges sharp."""

import io

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

from scan2albedo.albedo.division import divide_light
from scan2albedo.io.color import linear_to_srgb, srgb_to_linear

SIZE = 200
SKIN = np.array([0.6, 0.42, 0.33])


@pytest.fixture
def skin(rng):
    """Smooth skin with a lip: an edge of a third."""
    field = gaussian_filter(rng.standard_normal((SIZE, SIZE)), 3)
    albedo = 1 + 0.03 * field / field.std()
    albedo[:, SIZE // 2 :] *= 0.67
    return albedo[..., None] * SKIN


def _divided(texture, light=None, *, specular=0, mask=True, usable=True, **settings):
    """Divide a texture by light of 1, without highlights, everything of it usable, unless told otherwise."""
    shape = texture.shape[:2]
    light = np.ones(shape) if light is None else light
    return divide_light(texture, light, *(np.full(shape, f) for f in (specular, mask, usable)), **settings)


def _rms(estimate, truth):
    return float(np.sqrt(np.mean((estimate / truth - 1) ** 2)))


def _coded(linear):
    """Return colours as 8 bits hold them."""
    return srgb_to_linear(np.round(255 * np.clip(linear_to_srgb(linear), 0, 1)) / 255)


def test_what_is_not_filtered_is_the_quotient(lit):
    albedo, light = lit
    division = _divided(albedo * light, light, usable=False)
    assert division.albedo == pytest.approx(albedo)


def test_shrinking_beats_the_plain_quotient_in_the_dark_and_says_how_sure_it_is(lit, rng):
    albedo, light = lit
    noisy = albedo * light + 0.1 * rng.standard_normal(light.shape)
    shrunk = _divided(noisy, light)
    ours, others = (((found - albedo) ** 2).mean(1) for found in (shrunk.albedo, noisy / light))
    assert ours[-50:].mean() < 0.6 * others[-50:].mean()
    assert ours[:50].mean() < 1.05 * others[:50].mean()
    assert shrunk.confidence[-50:].mean() < 0.5 < shrunk.confidence[:50].mean()


def test_texels_not_usable_keep_the_quotient_at_no_confidence(lit):
    albedo, light = lit
    usable, mask = np.ones((2, SIZE, SIZE), bool)
    usable[50:60, 50:60], mask[:, 150:] = False, False
    division = _divided(albedo * light, light, mask=mask, usable=usable & mask)
    assert division.albedo[50:60, 50:60] == pytest.approx(albedo[50:60, 50:60])
    assert np.all(division.confidence[~usable] == 0)
    assert np.all(division.deviation[50:60, 50:60] == 1)
    assert np.all(division.albedo[~mask] == 0)


def test_a_highlight_stronger_than_the_texel_leaves_black_not_negative():
    assert np.all(_divided(np.full((40, 40), 0.1), specular=0.3).albedo == 0)


@pytest.mark.parametrize("noise", [0.0, 0.0005])
def test_what_no_lamp_reaches_is_divided_by_its_own_light(skin, noise, rng):
    """Ambient light is a fiftieth of the lamp's, and noise up to a tenth of what the texture has there."""
    light = np.ones((SIZE, SIZE))
    light[60:140] = 0.02 * (1 + np.linspace(0, 1, SIZE))
    texture = skin * light[..., None]
    noisy = texture + noise * rng.standard_normal(texture.shape)
    dark = np.s_[62:138]
    error = _divided(noisy, light).albedo[dark] / skin[dark] - 1
    assert abs(error.mean()) < 3e-3
    assert error.std() <= 0.5 * (noisy / texture)[dark].std() + 1e-9


@pytest.mark.parametrize("shared", [0.0, 0.06])
def test_white_noise_goes_and_the_mean_stays(skin, shared, rng):
    """Noise of each channel in value and hue, and noise that they nearly share."""
    noise = shared * rng.standard_normal((SIZE, SIZE, 1)) + 0.02 * rng.standard_normal(skin.shape)
    noisy = skin * (1 + noise)
    plain, filtered = noisy / skin, _divided(noisy).albedo / skin
    assert _rms(filtered[..., 0], 1) < 0.6 * _rms(plain[..., 0], 1)
    assert _rms(filtered[..., 2], filtered[..., 0]) < 0.5 * _rms(plain[..., 2], plain[..., 0])
    assert (filtered * skin).mean((0, 1)) == pytest.approx(noisy.mean((0, 1)), rel=5e-4)


@pytest.mark.parametrize("noise", [0.02, 0.05])
def test_an_edge_stays_as_sharp_as_it_is(skin, noise, rng):
    shared, own = rng.standard_normal((SIZE, SIZE, 1)), rng.standard_normal(skin.shape)
    noisy = skin * (1 + noise * (shared + 0.3 * own))
    profile = _divided(noisy).albedo[..., 0].mean(0)
    high, low = profile[75:95].mean(), profile[105:125].mean()
    share = (profile - low) / (high - low)
    # A step from one texel to the next: so much of it is left.
    assert share[99] - share[100] > 0.8
    assert share[98] > 0.95
    assert share[101] < 0.05


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_a_photograph_that_was_compressed_and_enlarged_is_not_blurred(skin, noise, rng):
    """Its noise is correlated: nothing tells it from texture."""
    noisy = skin * (1 + noise * rng.standard_normal(skin.shape))
    codes = Image.fromarray(np.uint8(np.round(255 * np.clip(linear_to_srgb(noisy), 0, 1))))
    stream = io.BytesIO()
    codes.save(stream, "JPEG", quality=85)
    large = np.asarray(Image.open(stream).resize((2 * SIZE, 2 * SIZE), Image.Resampling.BILINEAR))
    texture = srgb_to_linear(large / 255)
    division = _divided(texture)
    assert division.confidence.mean() > 0.98
    assert _rms(division.albedo, texture) < 0.003


def test_each_channel_is_divided_by_its_own_light(skin):
    light = np.linspace(1, 2, SIZE)[:, None, None] * [1.0, 0.8, 0.5] * np.ones_like(skin)
    division = _divided(skin * light, light)
    assert division.albedo == pytest.approx(skin, rel=1e-6)


@pytest.mark.parametrize("noise", [0.0, 0.02, 0.06])
def test_the_deviation_tells_how_far_texels_are_off(skin, noise, rng):
    """Within it lie about two thirds of the texels, within twice as much nearly all."""
    light = np.linspace(0.3, 1, SIZE)[:, None] * np.ones((1, SIZE))
    texture = skin * light[..., None] + 0.5 * noise * rng.standard_normal(skin.shape)
    division = _divided(_coded(texture), light)
    off = np.abs(division.albedo[..., 0] / skin[..., 0] - 1)
    assert 0.5 < np.mean(off < division.deviation) < 0.9
    assert np.mean(off < 2 * division.deviation) > 0.9
    # So it does where it is small and where it is large.
    for half in np.split(np.argsort(division.deviation, axis=None), 2):
        assert np.mean((off < 2 * division.deviation).ravel()[half]) > 0.85


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (2, 3), (4, 40)])
def test_images_of_a_few_texels_are_divided(shape):
    texture = np.full((*shape, 3), 0.5) * SKIN
    division = _divided(texture, np.full(shape, 2.0))
    assert division.albedo == pytest.approx(texture / 2)
    assert np.isfinite(division.deviation).all()


def test_nothing_usable_leaves_the_quotient():
    texture = np.full((30, 30, 3), 0.5)
    division = _divided(texture, usable=False)
    assert division.albedo == pytest.approx(texture)
    assert not division.confidence.any()


def test_a_part_of_an_image_joins_the_whole_without_a_seam():
    rng = np.random.default_rng(0)
    light = np.ones((160, 320, 3))
    # More noise is shared by the channels over most of the whole than over most of the part.
    shared = np.where(np.arange(320) < 200, 0.1, 0.02)[:, None]
    noise = 0.005 * rng.normal(size=light.shape) + shared * rng.normal(size=(160, 320, 1))
    texture = SKIN * np.maximum(light + noise, 0.01)
    whole = _divided(texture, light)
    alike, alone = (
        np.abs(_divided(texture[:, 130:], light[:, 130:], image_noise=usual).albedo - whole.albedo[:, 130:])
        for usual in (whole.noise, None)
    )
    assert alike[:, 40:].max() < 1e-6
    assert alone[:, 40:].max() > 1e-4
