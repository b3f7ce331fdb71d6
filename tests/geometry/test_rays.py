"""Rays against a brute-force intersection, and blocks of rows, worked on by all cores."""

import numpy as np
import pytest
from helpers.meshes import sphere
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.rays import RayCaster, blocks, each_block
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
    assert_array_equal(blocked, np.isfinite(expected))
    assert 5 < blocked.sum() < 55
    points = np.einsum("nk,nkd->nd", hits.barycentric, vertices[faces[hits.face]])[blocked]
    along = origins + directions * hits.distance[:, None]
    assert_allclose(points, along[blocked], atol=1e-5)
    assert (hits.face[~blocked] == -1).all()
    assert (hits.barycentric[~blocked] == 0).all()


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


def test_prepared_origins_one_common_direction_and_few_rays_at_once_give_the_same_answers():
    caster, down = RayCaster(*sphere(3, 10.0, [1e4, 0, 0])), np.array([0, 0, -1.0])
    origins = np.random.default_rng(4).uniform([-12, -12, 20], [12, 12, 20], (30_000, 3)) + [1e4, 0, 0]
    each = caster.occluded(origins, np.tile(down, (30_000, 1)))
    assert_array_equal(caster.occluded(origins, down), each)
    assert_array_equal(caster.occluded(caster.to_local(origins), down, local=True), each)
    few = [caster.occluded(part, down) for part in np.array_split(origins, 50)]
    assert_array_equal(np.concatenate(few), each)
    assert each.mean() == pytest.approx(np.pi * 100 / 24**2, rel=0.02)


def test_no_rays_no_answers():
    assert RayCaster(*sphere(1, 1.0)).occluded(np.zeros((0, 3)), [0, 0, 1.0]).shape == (0,)


def test_blocks_cover_all_rows_once():
    assert [(b.start, b.stop) for b in blocks(7, 3)] == [(0, 3), (3, 6), (6, 7)]
    assert blocks(0, 3) == []


@pytest.mark.parametrize("count", [1, 2, 9])
def test_every_block_is_worked_on_once_and_errors_come_through(count):
    done = []
    each_block(lambda block: done.append(block.start), blocks(count, 1))
    assert sorted(done) == list(range(count))

    def fail(block):
        raise RuntimeError(f"block {block.start}")

    with pytest.raises(RuntimeError, match="block"):
        each_block(fail, blocks(count, 1))
