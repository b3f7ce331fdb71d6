"""Soft light on surfaces: against sums over the sphere, and closed forms of what a surface hides."""

import numpy as np
import pytest
import trimesh

from scan2albedo.core import EnvironmentLight
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.lighting.environment import distant_directions
from scan2albedo.lighting.environment_light import (
    environment_light_on,
    environment_of_shading,
    open_shading,
    open_transfer,
    shadowed_transfer,
)
from scan2albedo.lighting.harmonics import harmonics
from scan2albedo.lighting.shadow_map import ShadowMap


def _of_rays(shadows, count):
    return shadowed_transfer(shadows, shadows.table(distant_directions(count)))


def test_open_surfaces_receive_the_clamped_cosine_of_the_radiance():
    normal = distant_directions(7)
    toward = distant_directions(20_000)
    radiance = harmonics(toward, 2) / harmonics(toward[:1], 0)
    expected = 4 / len(toward) * np.maximum(normal @ toward.T, 0) @ radiance
    assert open_transfer(normal) == pytest.approx(expected, abs=2e-4)


def test_constant_light_is_1_on_every_open_surface():
    normal = distant_directions(50)
    light = environment_light_on(EnvironmentLight.constant(), ShadowMap(None, 80 * normal, normal))
    assert light == pytest.approx(np.ones((50, 3)), abs=1e-12)


@pytest.mark.parametrize("depth", [0.5, 1.0, 2.0])
def test_the_bottom_of_a_pit_sees_what_its_wall_leaves(depth):
    """On the axis of a cylinder of radius 1 and this depth: 1 / (1 + depth^2)."""
    pit = trimesh.creation.annulus(1.0, 1.2, depth, sections=128)
    position = np.array([[0.0, 0, -depth / 2 - 1e-3]])
    shadows = ShadowMap(RayCaster(pit.vertices, pit.faces), position, np.array([[0.0, 0, 1]]), 1e-3)
    assert _of_rays(shadows, 4000)[0, 0] == pytest.approx(1 / (1 + depth**2), abs=0.01)
    filled = EnvironmentLight(np.eye(9, 3)[:, [0]] * np.ones(3), fill=0.5)
    seen = shadowed_transfer(shadows)[0, 0]
    assert environment_light_on(filled, shadows)[0] == pytest.approx(seen + 0.5 * (1 - seen))


def test_coefficients_of_the_shading_are_those_of_the_radiance_and_back():
    light = EnvironmentLight(np.random.default_rng(0).normal(size=(9, 3)), occluded=False)
    normal = distant_directions(20)
    shading = harmonics(normal, 2) @ open_shading(light)
    assert shading == pytest.approx(open_transfer(normal) @ light.coefficients)
    assert environment_of_shading(open_shading(light)).coefficients == pytest.approx(light.coefficients)


def test_a_floor_beside_a_high_wall_receives_half_of_every_harmonic():
    """Half of those even in x, and of x itself what -x of the open half brings: -2 / (3 pi) sqrt(3)."""
    # The wall is long and stands at x > 1.
    wall = trimesh.creation.box([1.0, 600.0, 300.0])
    wall.apply_translation([1.5, 0, 150])
    floor = np.array([[0.0, 0, 0.01]]), np.array([[0.0, 0, 1]])
    transfer = _of_rays(ShadowMap(RayCaster(wall.vertices, wall.faces), *floor, 1e-3), 8000)[0]
    toward = np.eye(3)
    slopes = (harmonics(toward, 1) / harmonics(toward, 0))[:, 1:]
    x, y, z = (int(np.abs(row).argmax()) for row in slopes)
    assert transfer[0] == pytest.approx(0.5, abs=0.005)
    assert transfer[1 + x] / slopes[0, x] == pytest.approx(-2 / (3 * np.pi), abs=0.005)
    assert transfer[1 + y] == pytest.approx(0, abs=0.005)
    assert transfer[1 + z] / slopes[2, z] == pytest.approx(1 / 3, abs=0.005)


def test_few_rays_leave_what_nothing_hides_exact():
    shadows = ShadowMap(RayCaster(np.eye(3) - 500, np.array([[0, 1, 2]])), np.zeros((4, 3)), np.eye(4, 3) + 0)
    shadows.normal[3] = [0, 0, 1]
    assert _of_rays(shadows, 24)[2:] == pytest.approx(open_transfer(shadows.normal)[2:], abs=1e-9)
