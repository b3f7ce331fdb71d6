"""Division by the light, noise told from texture, shrinkage."""

import numpy as np
import pytest

from scan2albedo.albedo.division import divide_light, noise_deviation

SIZE = 200


@pytest.fixture
def lit():
    """Texture, and light that falls from 5 to 1 down the image."""
    rng = np.random.default_rng(0)
    albedo = 0.5 + 0.05 * rng.standard_normal((SIZE, SIZE))
    light = np.broadcast_to(np.linspace(5, 1, SIZE)[:, None], albedo.shape).copy()
    return albedo, light, rng


def _everywhere(noisy, light, **settings):
    mask = np.ones(light.shape, bool)
    return divide_light(noisy, light, np.zeros(light.shape), mask, mask, **settings)


@pytest.mark.parametrize("noise", [0.02, 0.06, 0.2])
def test_noise_is_told_from_texture(lit, noise):
    albedo, light, rng = lit
    value = albedo * light + noise * rng.standard_normal(light.shape)
    assert noise_deviation(value, light, np.ones(light.shape, bool)) == pytest.approx(
        noise, rel=0.15, abs=0.012
    )


def test_texture_alone_is_not_taken_for_noise(lit):
    albedo, light, _ = lit
    found = noise_deviation(albedo * light, light, np.ones(light.shape, bool))
    assert found < 0.012
    assert noise_deviation(albedo, np.ones_like(light), np.ones(light.shape, bool)) == 0


def test_without_noise_the_quotient_is_exact(lit):
    albedo, light, _ = lit
    division = _everywhere(albedo * light, light, shrink=False)
    assert division.albedo == pytest.approx(albedo)


def test_shrinking_beats_the_plain_quotient_in_the_dark_and_says_how_sure_it_is(lit):
    albedo, light, rng = lit
    noisy = albedo * light + 0.1 * rng.standard_normal(light.shape)
    shrunk, plain = _everywhere(noisy, light), _everywhere(noisy, light, shrink=False)
    error = lambda a, rows: float(np.mean((a - albedo)[rows] ** 2))  # noqa: E731
    dark, bright = slice(-50, None), slice(None, 50)
    assert error(shrunk.albedo, dark) < 0.6 * error(plain.albedo, dark)
    assert error(shrunk.albedo, bright) < 1.05 * error(plain.albedo, bright)
    assert shrunk.confidence[dark].mean() < 0.5 < shrunk.confidence[bright].mean()


def test_texels_not_usable_keep_the_quotient_at_no_confidence(lit):
    albedo, light, _ = lit
    usable, mask = np.ones(light.shape, bool), np.ones(light.shape, bool)
    usable[50:60, 50:60], mask[:, 150:] = False, False
    division = divide_light(albedo * light, light, np.zeros(light.shape), mask, usable & mask)
    assert division.albedo[50:60, 50:60] == pytest.approx(albedo[50:60, 50:60], rel=1e-3)
    assert np.all(division.confidence[~usable] == 0)
    assert np.all(division.albedo[~mask] == 0)


def test_a_highlight_stronger_than_the_texel_leaves_black_not_negative():
    one = np.ones((40, 40))
    division = divide_light(0.1 * one, one, 0.3 * one, one > 0, one > 0)
    assert np.all(division.albedo == 0)


def test_albedo_goes_on_across_the_outline_of_a_deep_shadow():
    rng = np.random.default_rng(2)
    albedo = 0.5 + 0.02 * rng.standard_normal((SIZE, SIZE))
    light = np.full((SIZE, SIZE), 20.0)
    light[90:110, 90:110] = 1.0
    wrong = light.copy()
    # A little stray light that the estimate does not know doubles what arrives there.
    wrong[90:110, 90:110] = 2.0
    division = _everywhere(albedo * wrong, light)
    dark = slice(92, 108), slice(92, 108)
    assert division.albedo[dark] == pytest.approx(albedo[dark], abs=0.1)
    assert division.confidence[dark].max() < 0.05
    assert _everywhere(albedo * wrong, light, shrink=False).albedo[dark].mean() > 0.9


def test_light_is_continued_where_it_fades_out():
    """Stray light fills what a lamp does not reach: the albedo there is not that many times too bright."""
    rng = np.random.default_rng(2)
    albedo = 0.5 + 0.02 * rng.standard_normal((SIZE, SIZE))
    across = np.linspace(0, 1, SIZE)[None] * np.ones((SIZE, 1))
    light = 1 + 19 * np.maximum(0, 1 - 1.4 * across)
    division = _everywhere(albedo * (light + 2), light)
    far = np.s_[:, -20:]
    plain = _everywhere(albedo * (light + 2), light, shrink=False)
    assert plain.albedo[far].mean() == pytest.approx(1.5, rel=0.02)
    assert division.albedo[far].mean() < 1.25
    assert np.corrcoef(division.albedo[far].ravel(), albedo[far].ravel())[0, 1] > 0.9
