"""Shading by harmonics against the sum over thousands of distant lights, formula by formula."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.lobes import response_by_sums
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.errors import ReflectanceError
from scan2albedo.geometry.mesh import normalized
from scan2albedo.reflectance import reflectance_from_albedo, shade_environment


def smooth_light(seed, highest=4):
    """Positive light whose harmonics fade, as those of environments do."""
    light = 0.15 * np.random.default_rng(seed).normal(size=(81, 3))
    light[(highest + 1) ** 2 :] = 0
    light[0] = 4.0
    return light


def brute_force(reflectance, normals, view, light, horizon=True):
    """Sum the point-light formula over directions spread evenly over the sphere."""
    responses = [response_by_sums(n, v, horizon=horizon) for n, v in zip(normals, view, strict=True)]
    white, *lobes = np.moveaxis(responses, 1, 0) @ light
    return reflectance.diffuse_linear * white, np.einsum("vk,kvj->vj", reflectance.weights, lobes)


def scene(angles_deg):
    rng, shape = np.random.default_rng(0), (len(angles_deg), 3)
    normals = normalized(rng.normal(size=shape))
    side = normalized(np.cross(normals, rng.normal(size=shape)))
    angle = np.radians(angles_deg)[:, None]
    view = np.cos(angle) * normals + np.sin(angle) * side
    diffuse, weights = rng.uniform(0.1, 0.8, shape), rng.uniform(0.05, 0.4, shape)
    return reflectance_from_albedo(diffuse, weights=weights), normals, view


def test_along_the_normal_every_lobe_is_exact():
    reflectance, normals, _ = scene([0] * 6)
    normals[:2] = [[0, 0, 1], [0, 0, -1]]
    light = smooth_light(1)
    for lobe, horizon in (("full", False), ("tilted", True)):
        shading = shade_environment(reflectance, normals, normals, light, lobe=lobe)
        diffuse, specular = brute_force(reflectance, normals, normals, light, horizon)
        assert_allclose(shading.diffuse_linear, diffuse, rtol=1e-3)
        assert_allclose(shading.specular_linear, specular, rtol=1e-3)


def test_oblique_views_need_the_true_lobe():
    reflectance, normals, view = scene([45, 60, 60, 70, 75, 80])
    light = smooth_light(3, highest=2)
    diffuse, specular = brute_force(reflectance, normals, view, light)
    tilted, full = (
        shade_environment(reflectance, normals, view, light, lobe=lobe) for lobe in ("tilted", "full")
    )
    assert_allclose(tilted.diffuse_linear, diffuse, rtol=1e-3)
    assert_array_equal(tilted.radiance_linear, tilted.diffuse_linear + tilted.specular_linear)
    assert np.abs(tilted.specular_linear / specular - 1).mean() < 0.03
    assert np.abs(full.specular_linear / specular - 1).mean() > 0.5


def test_backs_have_no_highlight_and_the_unknown_no_number():
    reflectance, normals, view = scene([30, 30, 120])
    known = np.array([True, False, True])
    gaps = replace(reflectance, known=known)
    for lobe in ("tilted", "full"):
        shading = shade_environment(gaps, normals, view, smooth_light(6), lobe=lobe)
        assert (shading.specular_linear[2] == 0).all()
        assert_array_equal(np.isnan(shading.radiance_linear).any(1), ~known)


UP = np.tile([0.0, 0, 1], (2, 1))


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"normals": UP * [[1], [0]]}, ReflectanceError, r"vertex 1 .*no unit vector"),
        ({"toward_camera": UP * [[np.nan], [1]]}, ReflectanceError, r"vertex 0 .*no unit vector"),
        ({"light": np.zeros((9, 3))}, ValueError, r"\(81, 3\)"),
        ({"lobe": "phong"}, ValueError, "lobe must be"),
        ({"normals": UP[:1], "toward_camera": UP[:1]}, ValueError, "normals"),
    ],
)
def test_what_cannot_be_shaded_is_refused(changes, error, words):
    given = {"normals": UP, "toward_camera": UP, "light": smooth_light(0)} | changes
    with pytest.raises(error, match=words):
        shade_environment(scene([10, 20])[0], **given)
