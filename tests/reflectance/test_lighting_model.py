"""Light of generated places: reproducible, its scale in one place, and near to places not seen."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from worlds.environments import generated_environment, generated_lighting

from scan2albedo.errors import ReflectanceError
from scan2albedo.lighting.harmonics import project_environment
from scan2albedo.reflectance import LightingModel


def test_the_model_of_the_package_is_what_the_tool_builds(lighting):
    made = generated_lighting()
    assert_allclose(lighting.mean, made.mean, rtol=1e-9, atol=1e-9)
    along = np.einsum("nhc,nhc->n", lighting.basis, made.basis) / (lighting.deviation * made.deviation)
    assert_allclose(np.abs(along), 1, rtol=1e-6)
    assert_allclose(lighting.deviation, made.deviation, rtol=1e-9)


def test_the_mean_radiance_is_the_scale_and_nothing_else(lighting):
    assert lighting.components == 80
    assert (lighting.basis[:, 0] == 0).all()
    light = lighting.light(np.linspace(-2, 2, 80), scale_rgb=[0.5, 1.0, 3.0])
    assert_allclose(light[0] / np.sqrt(4 * np.pi), [0.5, 1.0, 3.0], rtol=1e-12)


def test_few_maps_of_your_own_make_a_small_model():
    maps = np.stack([generated_environment(seed) for seed in (1, 2)])
    assert LightingModel.from_coefficients(project_environment(maps)).components == 1
    one = LightingModel.from_coefficients(project_environment(maps[:1]))
    assert one.components == 0
    assert_allclose(one.light([]) * maps[0].mean(), one.mean * maps[0].mean())


DARK = np.zeros((2, 81, 3))
DARK[0, 0] = 1.0


@pytest.mark.parametrize(
    ("lights", "error", "words"),
    [
        (DARK, ReflectanceError, "light 1"),
        (np.full((2, 81, 3), np.nan), ReflectanceError, "NaN"),
        (np.ones((4, 8, 3)), ValueError, r"lights is \(4, 8, 3\)"),
        (np.ones((0, 81, 3)), ValueError, "no lights"),
    ],
)
def test_what_is_no_light_is_refused(lights, error, words):
    with pytest.raises(error, match=words):
        LightingModel.from_coefficients(lights)


def test_coefficients_that_are_none_are_refused(lighting):
    with pytest.raises(ReflectanceError, match="NaN"):
        lighting.light(np.full(80, np.nan))
    with pytest.raises(ValueError, match="coefficients is"):
        lighting.light(np.zeros(79))
