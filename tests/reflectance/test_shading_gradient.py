"""Derivatives of shading by normals and lines of sight, beside finite differences."""

import numpy as np
import pytest

from scan2albedo.geometry.mesh import normalized
from scan2albedo.reflectance import reflectance_from_albedo, shade_environment
from scan2albedo.reflectance.environment_shading import shading_gradient

RNG = np.random.default_rng(0)
DRAWN = normalized(RNG.normal(size=(300, 3)))
TURNED = normalized(DRAWN + 0.6 * RNG.normal(size=DRAWN.shape))
AHEAD = np.einsum("vi,vi->v", DRAWN, TURNED) > 0.05
NORMALS, VIEW = DRAWN[AHEAD], TURNED[AHEAD]
LIGHT = RNG.normal(size=(81, 3))


def reflectance(diffuse=1.0, lobes=(1.0, 1.0, 1.0)):
    weights, albedo = np.random.default_rng(1).uniform(0.1, 0.6, (2, *NORMALS.shape))
    return reflectance_from_albedo(diffuse * albedo, weights=weights * lobes)


def along_sphere(unit, seed):
    free = np.random.default_rng(seed).normal(size=unit.shape)
    return free - np.einsum("vi,vi->v", unit, free)[:, None] * unit


@pytest.mark.parametrize(
    "skin", [reflectance(), reflectance(lobes=(0, 0, 0)), *(reflectance(0.0, lobe) for lobe in np.eye(3))]
)
@pytest.mark.parametrize("straight", [False, True])
def test_derivatives_agree_with_finite_differences(skin, straight):
    at = np.stack([NORMALS, NORMALS if straight else VIEW])
    # Straight ahead the lobes' splines have a small kink.
    tolerance = 1e-4 if straight else 1e-7
    h = 1e-6

    def radiance(directions):
        return shade_environment(skin, *normalized(directions), LIGHT).radiance_linear

    scale = 1e-3
    for number, gradient in enumerate(shading_gradient(skin, *at, LIGHT)):
        step = np.zeros_like(at)
        step[number] = along_sphere(at[number], 2 + number)
        expected = (radiance(at + h * step) - radiance(at - h * step)) / (2 * h)
        scale = max(scale, np.abs(expected).max())
        found = np.einsum("vji,vi->vj", gradient, step[number])
        np.testing.assert_allclose(found, expected, atol=tolerance * scale)
