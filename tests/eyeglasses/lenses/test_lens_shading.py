"""Tint and reflection of a lens: closed forms, energy, superposition."""

import numpy as np
import pytest

from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.lenses.lens_shading import (
    blend_lens,
    environment_radiance,
    light_by_environment,
    mirror_on_sphere,
)

RNG = np.random.default_rng(0)
Z = np.array([0.0, 0, 1])


def unit(count):
    v = RNG.normal(size=(count, 3))
    return v / np.linalg.norm(v, axis=1)[:, None]


def test_shares_of_one_and_none():
    behind, tint, mirrored = RNG.random((3, 5, 4, 3))
    np.testing.assert_array_equal(blend_lens(behind, tint, mirrored, 0.0, 0.0), behind)
    np.testing.assert_array_equal(blend_lens(behind, tint, mirrored, 1.0, 0.0), tint)
    np.testing.assert_array_equal(blend_lens(behind, tint, mirrored, 0.0, 1.0), mirrored)
    alpha = RNG.random((5, 4))
    grey = blend_lens(np.ones((5, 4, 3)), np.ones(3), np.ones(3), alpha, 1 - alpha)
    np.testing.assert_allclose(grey, 1, atol=1e-15)


@pytest.mark.parametrize(("alpha", "beta"), [(0.6, 0.5), (-0.1, 0.2), (0.2, -1e-3), (np.nan, 0), (0, np.inf)])
def test_a_lens_gives_no_more_light_than_it_gets(alpha, beta):
    with pytest.raises(EyeglassesError, match=r"alpha|beta"):
        blend_lens(np.ones(3), np.ones(3), np.ones(3), alpha, beta)


def test_the_sphere_mirrors_as_spheres_do():
    center, radius = np.array([30.0, 0, 5]), 80.0
    middle = center - radius * Z
    outward = unit(500)
    outward = outward[outward[:, 2] > 0.9]
    incoming = unit(len(outward)) - 2 * outward
    # Points in the lens's plane stand for those of the sphere along its radius.
    points = middle + outward * (radius / outward[:, 2])[:, None]
    got = mirror_on_sphere(points, incoming, center, Z, radius)
    heading = incoming / np.linalg.norm(incoming, axis=1)[:, None]
    np.testing.assert_allclose((got * outward).sum(1), -(heading * outward).sum(1), atol=1e-12)
    np.testing.assert_allclose(np.cross(got - heading, outward), 0, atol=1e-12)
    flat = mirror_on_sphere(points, incoming, center, 2 * Z, np.inf)
    np.testing.assert_allclose(flat, heading * [1, 1, -1], atol=1e-15)
    with pytest.raises(EyeglassesError, match="positive"):
        mirror_on_sphere(points, incoming, center, Z, 0.0)


def test_the_environment_lies_where_its_axes_say():
    height, width = 180, 360
    row, column = np.meshgrid(np.arange(height) + 0.5, np.arange(width) + 0.5, indexing="ij")
    azimuth, polar = (column / width - 0.5) * 2 * np.pi, row / height * np.pi
    sphere = np.stack([np.sin(polar) * np.sin(azimuth), np.cos(polar), np.sin(polar) * np.cos(azimuth)], -1)
    directions = np.concatenate([unit(300), np.eye(3), -np.eye(3)])
    np.testing.assert_allclose(environment_radiance(sphere, 7 * directions), directions, atol=0.01)
    with pytest.raises(ValueError, match="shape"):
        environment_radiance(np.zeros((4, 4)), directions)


def test_light_superposes():
    maps, weights, directions = RNG.random((6, 8, 16, 3)), RNG.random(6), unit(50)
    apart = np.stack([environment_radiance(m, directions) for m in maps])
    together = environment_radiance(light_by_environment(maps, weights), directions)
    np.testing.assert_allclose(together, light_by_environment(apart, weights), rtol=1e-12)
    behind = RNG.random((6, 50, 3))

    def lens(b, r):
        return blend_lens(b, np.zeros(3), r, 0.3, 0.2)

    mixed = lens(light_by_environment(behind, weights), together)
    np.testing.assert_allclose(mixed, light_by_environment(lens(behind, apart), weights), rtol=1e-12)
    coloured = light_by_environment(behind, np.outer(weights, [1, 0, 2]))
    np.testing.assert_allclose(coloured, light_by_environment(behind, weights) * [1, 0, 2], rtol=1e-12)
    with pytest.raises(ValueError, match="weights"):
        light_by_environment(behind, weights[:5])
