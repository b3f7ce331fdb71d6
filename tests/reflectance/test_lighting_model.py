"""Light of generated places: reproducible, its scale in one place, and near to places not seen."""

import numpy as np
import pytest
from worlds.environments import generated_environment, generated_lighting

from scan2albedo.errors import ReflectanceError
from scan2albedo.lighting.harmonics import project_environment
from scan2albedo.reflectance import LightingModel


@pytest.fixture(scope="module")
def model():
    return LightingModel.default()


def projected(model, light):
    """Coefficients and mean radiance of the model's light nearest to one (81, 3)."""
    off = (light * (np.sqrt(4 * np.pi) / light[0]) - model.mean).ravel()
    return model.basis.reshape(model.components, -1) @ off / model.deviation**2, light[0] / np.sqrt(4 * np.pi)


def test_places_are_bright_reproducible_and_of_many_kinds():
    maps = np.stack([generated_environment(seed) for seed in range(40)])
    np.testing.assert_array_equal(maps[3], generated_environment(3))
    assert np.isfinite(maps).all()
    assert maps.min() > 0
    mean = maps.mean((1, 2))
    assert mean.max() / mean.min() > 10
    warm = mean[:, 0] / mean[:, 2]
    assert warm.max() > 2
    assert warm.min() < 1


def test_light_comes_from_above_and_from_any_side(model):
    assert model.mean[1].min() > 0.3
    assert np.abs(model.mean[[2, 3]]).max() < 0.3


def test_the_same_seed_gives_the_same_model():
    one, two = (generated_lighting(count=30, seed=4) for _ in range(2))
    np.testing.assert_array_equal(one.basis, two.basis)
    assert one.components == 29
    assert not np.allclose(one.mean, generated_lighting(count=30, seed=5).mean)


def test_the_model_of_the_package_is_what_the_tool_builds(model):
    made = generated_lighting()
    np.testing.assert_allclose(model.mean, made.mean, rtol=1e-9, atol=1e-9)
    along = np.einsum("nhc,nhc->n", model.basis, made.basis) / (model.deviation * made.deviation)
    np.testing.assert_allclose(np.abs(along), 1, rtol=1e-6)
    np.testing.assert_allclose(model.deviation, made.deviation, rtol=1e-9)


def test_the_mean_radiance_is_the_scale_and_nothing_else(model):
    assert model.components == 80
    assert (model.basis[:, 0] == 0).all()
    light = model.light(np.linspace(-2, 2, 80), scale_rgb=[0.5, 1.0, 3.0])
    np.testing.assert_allclose(light[0] / np.sqrt(4 * np.pi), [0.5, 1.0, 3.0], rtol=1e-12)


def test_places_not_seen_are_near_the_model(model):
    errors = []
    maps = np.stack([generated_environment(seed) for seed in range(1000, 1030)])
    for light in project_environment(maps):
        gamma, scale = projected(model, light)
        errors.append(np.linalg.norm(model.light(gamma, scale_rgb=scale) - light) / np.linalg.norm(light))
    assert np.mean(errors) < 0.1
    whole = generated_lighting(count=600, components=600)
    assert np.sum(model.deviation**2) > 0.99 * np.sum(whole.deviation**2)


def test_light_of_the_model_is_found_again(model):
    truth = np.random.default_rng(0).normal(size=80)
    gamma, scale = projected(model, model.light(truth, scale_rgb=[1.0, 2.0, 3.0]))
    np.testing.assert_allclose(gamma, truth, atol=1e-9)
    np.testing.assert_allclose(scale, [1, 2, 3], rtol=1e-12)


def test_few_maps_of_your_own_make_a_small_model():
    maps = np.stack([generated_environment(seed) for seed in (1, 2)])
    assert LightingModel.from_coefficients(project_environment(maps)).components == 1
    one = LightingModel.from_coefficients(project_environment(maps[:1]))
    assert one.components == 0
    np.testing.assert_allclose(one.light([]) * maps[0].mean(), one.mean * maps[0].mean())


def test_what_is_no_light_is_refused(model):
    dark = np.zeros((2, 81, 3))
    dark[0, 0] = 1.0
    with pytest.raises(ReflectanceError, match="light 1"):
        LightingModel.from_coefficients(dark)
    with pytest.raises(ReflectanceError, match="NaN"):
        LightingModel.from_coefficients(np.full((2, 81, 3), np.nan))
    with pytest.raises(ReflectanceError, match="NaN"):
        model.light(np.full(80, np.nan))
    with pytest.raises(ValueError, match="coefficients is"):
        model.light(np.zeros(79))
    with pytest.raises(ValueError, match=r"lights is \(4, 8, 3\)"):
        LightingModel.from_coefficients(np.ones((4, 8, 3)))
