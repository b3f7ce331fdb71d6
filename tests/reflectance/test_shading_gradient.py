"""Derivatives of shading by normals and lines of sight, beside finite differences."""

import numpy as np
import pytest

from scan2albedo.geometry.mesh import normalized
from scan2albedo.reflectance import VertexReflectance, shade_environment
from scan2albedo.reflectance.environment_shading import shading_gradient

RNG = np.random.default_rng(0)
DRAWN = normalized(RNG.normal(size=(300, 3)))
TURNED = normalized(DRAWN + 0.6 * RNG.normal(size=DRAWN.shape))
AHEAD = np.einsum("vi,vi->v", DRAWN, TURNED) > 0.05
NORMALS, VIEW = DRAWN[AHEAD], TURNED[AHEAD]
LIGHT = RNG.normal(size=(81, 3))


def reflectance(diffuse=1.0, lobes=(1.0, 1.0, 1.0)):
    rng, count = np.random.default_rng(1), len(NORMALS)
    weights = rng.uniform(0.1, 0.6, (count, 3)) * lobes
    return VertexReflectance(diffuse * rng.uniform(0.1, 0.6, (count, 3)), weights, np.ones(count, bool))


def along_sphere(unit, seed):
    free = np.random.default_rng(seed).normal(size=unit.shape)
    return free - np.einsum("vi,vi->v", unit, free)[:, None] * unit


@pytest.mark.parametrize(
    "skin", [reflectance(), reflectance(lobes=(0, 0, 0)), *(reflectance(0.0, lobe) for lobe in np.eye(3))]
)
@pytest.mark.parametrize("straight", [False, True])
def test_derivatives_agree_with_finite_differences(skin, straight):
    normals = NORMALS
    view = NORMALS.copy() if straight else VIEW
    h = 1e-6

    def radiance(n, v):
        return shade_environment(skin, normalized(n), normalized(v), LIGHT).radiance_linear

    gradient = shading_gradient(skin, normals, view, LIGHT)
    dn, dv = along_sphere(normals, 2), along_sphere(view, 3)
    by_normal = (radiance(normals + h * dn, view) - radiance(normals - h * dn, view)) / (2 * h)
    by_view = (radiance(normals, view + h * dv) - radiance(normals, view - h * dv)) / (2 * h)
    found = np.einsum("vji,vi->vj", gradient[0], dn), np.einsum("vji,vi->vj", gradient[1], dv)
    # Straight ahead the lobes' splines have a small kink.
    tolerance = 1e-4 if straight else 1e-7
    np.testing.assert_allclose(found[0], by_normal, atol=tolerance * max(np.abs(by_normal).max(), 1e-3))
    np.testing.assert_allclose(found[1], by_view, atol=tolerance * max(np.abs(by_normal).max(), 1e-3))


def test_no_light_has_no_derivatives():
    gradient = shading_gradient(reflectance(), NORMALS, VIEW, np.zeros((81, 3)))
    assert (gradient[0] == 0).all()
    assert (gradient[1] == 0).all()
