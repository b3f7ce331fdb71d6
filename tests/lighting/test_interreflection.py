"""One bounce of light off a surface, and values looked up along it, against closed forms."""

import numpy as np
import pytest
import trimesh
from helpers.meshes import grid

from scan2albedo.core import EnvironmentLight
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.lighting.environment_light import (
    Patches,
    environment_light_on,
    surface_keys,
    surface_weights,
)
from scan2albedo.lighting.shadow_map import ShadowMap

OFFSET_MM = 0.01


def _inside_of(mesh, keep=slice(None)):
    """Return what casts rays, and the centres and inner normals of its faces."""
    caster = RayCaster(np.asarray(mesh.vertices), np.asarray(mesh.faces)[keep])
    return caster, np.asarray(mesh.triangles_center)[keep], -mesh.face_normals[keep]


def test_inside_a_sphere_every_patch_sees_all_others_alike_and_bounced_light_is_the_mean():
    caster, center, normal = _inside_of(trimesh.creation.icosphere(3, 50.0))
    patches = Patches.of(caster, center, normal, OFFSET_MM)
    count = len(patches.factors)
    assert patches.factors.sum(1) == pytest.approx(np.ones(count), abs=0.01)
    # The same 128 directions from everywhere: only sums over many patches are smooth.
    half = center[:, 0] > 0
    assert patches.factors[:, half].sum(1) == pytest.approx(np.full(count, half.mean()), abs=0.08)
    assert patches.factors[:, half].sum(1).mean() == pytest.approx(half.mean(), abs=0.01)
    bounce = patches.seen_from(center, normal)
    light = 1 + 0.5 * center[:, 0] / 50
    bounced = bounce(np.column_stack([np.ones_like(light), light])).T
    assert bounced[0] == pytest.approx(np.ones_like(light), abs=0.03)
    assert bounced[1].mean() == pytest.approx(light.mean(), abs=0.01)
    assert bounced[1].std() < 0.03


def test_a_convex_surface_throws_no_light_onto_itself():
    mesh = trimesh.creation.icosphere(3, 50.0)
    caster, center, inner = _inside_of(mesh)
    patches = Patches.of(caster, center, -inner, OFFSET_MM)
    assert not patches.factors.any()
    assert not patches.seen_from(center, -inner)(np.ones(len(center))).any()


def test_light_that_passes_a_hole_to_an_inner_side_is_not_thrown_back():
    """The plate above turns its back to the floor: its outer side is the upper one."""
    plate = trimesh.creation.box([100, 100, 0.1])
    plate.apply_translation([0, 0, 30])
    points = np.array([[0.0, 0, 0], [0, 0, 30.05]])
    for turned, hidden in ((1.0, False), (-1.0, True)):
        normal = np.array([[0, 0, 1.0], [0, 0, turned]])
        factors = Patches.of(RayCaster(plate.vertices, plate.faces), points, normal, OFFSET_MM).factors
        assert (factors[0, 1] > 0.5) == hidden


def test_patches_among_points_bounce_as_all_points_do():
    mesh = trimesh.creation.icosphere(3, 50.0)
    bowl = _inside_of(mesh, mesh.triangles_center[:, 2] < 0)
    _, center, normal = bowl
    shadows = ShadowMap(*bowl, OFFSET_MM)
    patches = Patches.among(shadows)
    assert len(patches.factors) < len(center)
    bounce = patches.seen_from(center, normal)
    light = 1 + center[:, 0] / 100
    off = bounce(light) - Patches.of(*bowl, OFFSET_MM).seen_from(center, normal)(light)
    assert np.sqrt(np.mean(off**2)) < 0.006
    assert np.abs(off).max() < 0.04
    environment = EnvironmentLight(np.zeros((9, 3)), bounce=0.4)
    lamps = light[:, None] * [1.0, 0.5, 0.0]
    lit = environment_light_on(environment, shadows, lamps)
    assert lit == pytest.approx(lamps + 0.4 * bounce(lamps))


def test_a_lookup_does_not_leak_across_a_fold():
    # Two sheets 1 mm apart, back to back.
    sheet = 60 * grid(15, 15)[0]
    up = np.tile([0.0, 0, 1], (len(sheet), 1))
    known = surface_keys(np.vstack([sheet, sheet - [0, 0, 1.0]]), np.vstack([up, -up]))
    value = np.repeat([0.0, 1.0], len(sheet))
    between = sheet + [1.7, 0.9, 0]
    assert not (surface_weights(known, surface_keys(between, up)) @ value).any()
    below = surface_keys(between - [0, 0, 1.0], -up)
    assert surface_weights(known, below) @ value == pytest.approx(np.ones(len(sheet)))


def test_a_lookup_of_fewer_points_than_neighbours():
    one, three = surface_keys(np.zeros((1, 3)), np.array([[0.0, 0, 1]])), np.ones((3, 6))
    assert (surface_weights(one, three) @ [2.0]).tolist() == [2, 2, 2]
