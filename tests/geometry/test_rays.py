"""Rays against the closed form of a sphere and a brute-force intersection."""

import numpy as np
import pytest
from helpers.meshes import sphere
from numpy.testing import assert_allclose

from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.geometry.rigid import random_rotation


def nearest_by_brute_force(vertices, faces, origin, direction):
    """Moller-Trumbore over every face in float64: the slow, obvious reference."""
    best = np.inf
    for a, b, c in vertices[faces]:
        system = np.stack([-direction, b - a, c - a], 1)
        if abs(np.linalg.det(system)) < 1e-14:
            continue
        distance, u, v = np.linalg.solve(system, origin - a)
        if distance > 0 and u >= 0 and v >= 0 and u + v <= 1:
            best = min(best, distance)
    return best


def test_rays_at_a_sphere_hit_where_the_quadratic_says():
    vertices, faces = sphere(5, 50.0)
    rng = np.random.default_rng(0)
    offset = rng.uniform(-45, 45, (400, 2))
    inside = np.hypot(*offset.T) < 45
    origins = np.column_stack([offset, np.full(400, 200.0)])
    hits = RayCaster(vertices, faces).first_hit(origins, [0, 0, -1.0])
    expected = 200 - np.sqrt(np.maximum(50**2 - (offset**2).sum(1), 0))
    assert (hits.face[inside] >= 0).all()
    assert_allclose(hits.distance[inside], expected[inside], atol=0.1)
    corners = vertices[faces[hits.face[inside]]]
    points = np.einsum("nk,nkd->nd", hits.barycentric[inside], corners)
    along = origins[inside] - [0, 0, 1.0] * hits.distance[inside, None]
    assert_allclose(points, along, atol=1e-3)


def test_rays_agree_with_brute_force_in_any_direction():
    vertices, faces = sphere(1, 1.0)
    vertices = vertices * [1, 2, 0.5] @ random_rotation(np.random.default_rng(1)).T
    rng = np.random.default_rng(2)
    origins = rng.normal(size=(60, 3)) * 3
    directions = normalized(-origins + rng.normal(scale=0.6, size=(60, 3)))
    hits = RayCaster(vertices, faces).first_hit(origins, directions)
    expected = [
        nearest_by_brute_force(vertices, faces, o, d) for o, d in zip(origins, directions, strict=True)
    ]
    assert_allclose(hits.distance, expected, atol=1e-5)
    blocked = RayCaster(vertices, faces).occluded(origins, directions)
    assert (blocked == np.isfinite(expected)).all()
    assert 5 < blocked.sum() < 55


def test_a_miss_is_minus_one_and_infinitely_far():
    hits = RayCaster(*sphere(2, 1.0)).first_hit([[0, 0, 5.0]], [[0, 0, 1.0]])
    assert hits.face[0] == -1
    assert hits.distance[0] == np.inf
    assert (hits.barycentric == 0).all()


@pytest.mark.parametrize("offset", [0.0, 1e4, 1e6])
@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_neither_the_origin_nor_the_unit_matters(offset, unit):
    """Embree computes in float32: a face 1e6 mm away would lose all detail without centring."""
    center = np.array([offset, -offset, offset]) * unit
    vertices, faces = sphere(4, 80.0 * unit, center)
    origins = center + np.array([[0, 0, 200.0], [30, 10, 200], [79, 79, 200]]) * unit
    hits = RayCaster(vertices, faces).first_hit(origins, [0, 0, -1.0])
    expected = np.array([120.0, 200 - np.sqrt(80**2 - 1000), np.inf]) * unit
    assert_allclose(hits.distance, expected, rtol=2e-3)


def test_many_rays_across_threads_equal_few():
    caster = RayCaster(*sphere(3, 10.0))
    rng = np.random.default_rng(3)
    origins = np.column_stack([rng.uniform(-12, 12, (40_000, 2)), np.full(40_000, 20.0)])
    many = caster.occluded(origins, [0, 0, -1.0])
    few = np.concatenate([caster.occluded(part, [0, 0, -1.0]) for part in np.array_split(origins, 50)])
    assert (many == few).all()


def test_prepared_origins_and_one_common_direction_give_the_same_answers():
    caster = RayCaster(*sphere(3, 10.0, [1e4, 0, 0]))
    rng = np.random.default_rng(4)
    origins = np.column_stack(
        [1e4 + rng.uniform(-12, 12, 30_000), rng.uniform(-12, 12, 30_000), np.full(30_000, 20.0)]
    )
    each = caster.occluded(origins, np.tile([0, 0, -1.0], (30_000, 1)))
    assert np.array_equal(caster.occluded(origins, [0, 0, -1.0]), each)
    assert np.array_equal(caster.occluded(caster.to_local(origins), [0, 0, -1.0], local=True), each)
    assert each.mean() == pytest.approx(np.pi * 100 / 24**2, rel=0.02)


def test_no_rays_no_answers():
    assert RayCaster(*sphere(1, 1.0)).occluded(np.zeros((0, 3)), [0, 0, 1.0]).shape == (0,)
