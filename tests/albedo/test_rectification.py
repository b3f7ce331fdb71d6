"""Lines along shadow outlines are repaired; nothing else is touched."""

import numpy as np
import pytest

from scan2albedo.albedo.poisson import forward_differences, integrate_gradients
from scan2albedo.albedo.rectification import rectify

SIZE = 128


@pytest.fixture
def shadowed(scenes):
    """Texture under a shadow whose estimated edge is one texel off the real one, and the same edge exact."""
    albedo = scenes.texture("skin", SIZE)[..., 0]
    rows, columns = np.mgrid[:SIZE, :SIZE]
    shadow = ((rows - 60) ** 2 + (columns - 64) ** 2 < 30**2).astype(float)
    light = 1 + 3 * (1 - shadow)
    moved = 1 + 3 * (1 - np.roll(shadow, 1, 1))
    return albedo, shadow, light, albedo * moved / light


EVERYWHERE = np.ones((SIZE, SIZE), bool)


def test_a_misplaced_outline_is_repaired(shadowed):
    albedo, shadow, light, wrong = shadowed
    result = rectify(wrong, light, shadow, EVERYWHERE)
    assert result.changed
    assert np.mean((result.albedo - albedo) ** 2) < 0.1 * np.mean((wrong - albedo) ** 2)


def test_an_exact_outline_is_left_alone(shadowed):
    albedo, shadow, light, _ = shadowed
    result = rectify(albedo, light, shadow, EVERYWHERE)
    assert not result.changed
    assert result.albedo is albedo
    assert "steep gradients" in result.evidence


def test_forced_repair_of_an_exact_outline_does_little_harm(shadowed):
    albedo, shadow, light, wrong = shadowed
    forced = rectify(albedo, light, shadow, EVERYWHERE, force=True).albedo
    assert np.mean((forced - albedo) ** 2) < 0.02 * np.mean((wrong - albedo) ** 2)


def test_no_outline_no_change(shadowed):
    albedo, shadow, light, _ = shadowed
    result = rectify(albedo, np.ones_like(light), shadow, EVERYWHERE)
    assert not result.changed
    assert result.evidence == "no shadow outline"


def test_gradients_integrate_to_the_field_they_came_from(shadowed):
    albedo, shadow, *_ = shadowed
    region = shadow > 0
    broken = np.where(region, 7.0, albedo)
    rebuilt = integrate_gradients(broken, region, ~region, *forward_differences(albedo))
    assert rebuilt == pytest.approx(albedo, abs=1e-4)


def test_a_region_that_touches_nothing_known_keeps_its_level(shadowed):
    albedo, shadow, *_ = shadowed
    region = shadow > 0
    nothing = np.zeros_like(region)
    kept = integrate_gradients(albedo, region, nothing, *forward_differences(albedo))
    assert kept == pytest.approx(albedo, abs=1e-6)
