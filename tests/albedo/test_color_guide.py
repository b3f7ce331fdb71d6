"""What colour tells of the texture, on textures of one pigment, of none, and with what misleads it."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from scan2albedo.albedo.color_guide import ColorGuide, _noise_variance, color_guide
from scan2albedo.albedo.levels import build_level
from scan2albedo.core.geometry_image import GeometryImage

SIZE = 96
ABSORPTION = np.array([0.6, 1.4, 2.2])


def _level(texture):
    position = np.dstack([*np.meshgrid(np.arange(SIZE), -np.arange(SIZE)), np.zeros((SIZE, SIZE))])
    normal = np.broadcast_to([0.0, 0.0, 1.0], position.shape)
    image = GeometryImage(position, normal, np.ones((SIZE, SIZE), bool), texture_linear=texture)
    return build_level(image, image.mask, SIZE)


def _concentration(seed=0):
    """Fine blotches about 1, without anything slow: that may be light, and the guide leaves it alone."""
    noise = np.random.default_rng(seed).standard_normal((SIZE, SIZE))
    fine = gaussian_filter(noise, 1) - gaussian_filter(noise, 5)
    return np.maximum(1 + 0.3 * fine / fine.std(), 0)


def _shading():
    """Light that is more than twice as strong on the right."""
    return np.broadcast_to(np.linspace(0.4, 0.9, SIZE), (SIZE, SIZE))


def _pigmented(shading=None):
    albedo = np.exp(-_concentration()[..., None] * ABSORPTION)
    return albedo * (_shading() if shading is None else shading)[..., None]


def _correlation(a, b):
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])


@pytest.fixture(scope="module")
def pigmented():
    return color_guide(_level(_pigmented()))


def test_one_pigment_explains_nearly_all_local_change(pigmented):
    assert pigmented.explained > 0.95


def test_the_guide_is_the_texture_but_for_a_constant(pigmented):
    true = -ABSORPTION[0] * _concentration()
    guide = np.log(pigmented.albedo).reshape(SIZE, SIZE)
    assert _correlation(guide, true) > 0.99
    # What a Gaussian of an eighth of the chart takes for slow is left out of the guide.
    assert np.polyfit(true.ravel(), guide.ravel(), 1)[0] == pytest.approx(1, abs=0.03)
    assert np.std(guide - true) < 0.15 * np.std(true)


def test_the_guide_does_not_follow_the_light(pigmented):
    guide = np.log(pigmented.albedo).reshape(SIZE, SIZE)
    shading = np.log(_shading())
    slope = np.polyfit(shading.ravel(), guide.ravel(), 1)[0]
    assert abs(slope) < 0.02
    plain = color_guide(_level(_pigmented(np.full((SIZE, SIZE), 0.6))))
    assert pigmented.albedo == pytest.approx(plain.albedo, rel=0.02)


def test_dividing_by_the_guide_leaves_the_light(pigmented):
    level = _level(_pigmented())
    before, after = (
        np.std(np.log(values).reshape(SIZE, SIZE) - np.log(_shading()))
        for values in (level.value, level.value / pigmented.albedo)
    )
    assert after < 0.15 * before


def test_grey_texture_tells_nothing():
    grey = np.exp(-0.6 * _concentration())[..., None] * np.ones(3) * _shading()[..., None]
    guide = color_guide(_level(grey))
    assert guide.albedo == pytest.approx(1, abs=1e-6)
    assert guide.explained == pytest.approx(0, abs=1e-6)


def test_plain_texture_tells_nothing():
    guide = color_guide(_level(np.full((SIZE, SIZE, 3), 0.5)))
    assert guide.albedo == pytest.approx(1)
    assert guide.explained == 0


def test_coloured_light_that_changes_slowly_is_not_taken_for_pigment():
    tint = np.ones((SIZE, SIZE, 3))
    tint[..., 2] = np.linspace(1, 1.6, SIZE)
    plain, tinted = color_guide(_level(_pigmented())), color_guide(_level(_pigmented() * tint))
    # At the rim a Gaussian of an eighth of the chart sees one side only.
    inner = np.s_[24:-24, 24:-24]
    change = np.log(tinted.albedo / plain.albedo).reshape(SIZE, SIZE)[inner]
    # Uncorrected, the tint's 0.47 of log blue, half of it inside, would be 0.07 of log V.
    assert np.ptp(change) < 0.02


def test_a_highlight_that_is_known_is_not_taken_for_pigment():
    row, column = np.indices((SIZE, SIZE))
    gloss = 0.25 * np.exp(-((row - 48.0) ** 2 + (column - 48.0) ** 2) / (2 * 2.5**2))
    texture = _pigmented(np.full((SIZE, SIZE), 0.6))
    level = _level(texture + gloss[..., None])
    clean, told, untold = (
        guide.albedo.reshape(SIZE, SIZE)
        for guide in (
            color_guide(_level(texture)),
            color_guide(level, gloss.ravel() / level.unit),
            color_guide(level),
        )
    )
    peak = gloss > 0.15
    assert told == pytest.approx(clean, rel=1e-3)
    assert np.mean(untold[peak] / clean[peak]) > 1.1


def test_a_highlight_brighter_than_the_image_leaves_the_guide_finite():
    level = _level(_pigmented())
    guide = color_guide(level, 2 * level.value)
    assert np.isfinite(guide.albedo).all()
    assert np.isfinite(guide.explained)


def test_noise_shrinks_the_guide_and_does_not_blow_it_up():
    rng = np.random.default_rng(1)
    noise = rng.standard_normal((SIZE, SIZE, 3))
    spreads, explained = [], []
    for strength in (0.0, 0.02, 0.05, 0.1):
        texture = np.maximum(_pigmented() * (1 + strength * noise), 1e-3)
        guide = color_guide(_level(texture))
        true = -ABSORPTION[0] * _concentration().ravel()
        spreads.append(float(np.polyfit(true, np.log(guide.albedo), 1)[0]))
        explained.append(guide.explained)
        assert np.std(np.log(guide.albedo)) < 1.1 * np.std(true)
    assert np.all(np.diff(spreads) < 0)
    assert np.all(np.diff(explained) < 0)
    assert spreads[-1] < 0.85


def test_grey_texture_under_noise_tells_hardly_anything():
    noise = np.random.default_rng(2).standard_normal((SIZE, SIZE, 3))
    grey = 0.6 * np.exp(-0.6 * _concentration())[..., None] * np.ones(3)
    guide = color_guide(_level(grey * (1 + 0.01 * noise)))
    assert guide.explained < 0.05
    assert np.std(np.log(guide.albedo)) < 0.02


@pytest.mark.parametrize("channels", [[1, 2], [0, 2], [0, 1]], ids=["red", "green", "blue"])
def test_black_channels_leave_it_finite(channels):
    texture = _pigmented()
    texture[..., channels] = 0
    guide = color_guide(_level(texture))
    assert np.isfinite(guide.albedo).all()
    assert guide.albedo.min() > 0
    assert np.abs(np.log(guide.albedo)).max() <= 3


def test_black_spots_leave_the_rest_alone():
    texture = _pigmented()
    clean = color_guide(_level(texture)).albedo.reshape(SIZE, SIZE)
    texture[30:32, 30:32] = 0
    guide = color_guide(_level(texture)).albedo.reshape(SIZE, SIZE)
    assert np.isfinite(guide).all()
    assert guide[:, :8] == pytest.approx(clean[:, :8], rel=0.05)


def test_no_guide_predicts_nothing():
    guide = ColorGuide.none(5)
    assert guide.albedo.tolist() == [1] * 5
    assert guide.explained == 0


def _noisy_pigment(strength):
    noise = np.random.default_rng(4).standard_normal((SIZE, SIZE, 3))
    return np.maximum(_pigmented() + strength * noise, 0)


def test_noise_that_v_and_the_hues_share_does_not_turn_the_slope():
    # The hue's change by noise goes against V's: least squares alone sees V brighten where hue deepens.
    true = -ABSORPTION[0] * _concentration()
    guide = color_guide(_level(_noisy_pigment(0.03)))
    slow = np.s_[8:-8, 8:-8]
    smooth_true, smooth_guide = (
        gaussian_filter(field, 2)[slow] for field in (true, np.log(guide.albedo).reshape(SIZE, SIZE))
    )
    assert guide.explained > 0
    assert _correlation(smooth_true, smooth_guide) > 0.8


@pytest.mark.parametrize("strength", [0.1, 0.3])
def test_noise_stronger_than_the_texture_is_no_texture(strength):
    noise = np.random.default_rng(5).standard_normal((SIZE, SIZE, 3))
    guide = color_guide(_level(np.maximum(0.5 + strength * noise, 0)))
    assert guide.explained == 0
    assert np.all(guide.albedo == 1)


def test_the_noise_of_a_cell_is_told_from_its_texture():
    level = _level(_noisy_pigment(0.02))
    assert np.sqrt(_noise_variance(level, level.color)) * level.unit == pytest.approx(0.02, rel=0.1)
    clean = _level(_pigmented())
    assert np.sqrt(_noise_variance(clean, clean.color)) * clean.unit < 0.002
