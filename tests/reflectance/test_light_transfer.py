"""Light with cast shadows: closed forms, sums with shadows known exactly, units, gaps, bad input."""

import numpy as np
import pytest
from helpers.lobes import lobes_under
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import ConvexHull
from worlds.environments import generated_environment

from scan2albedo.errors import ReflectanceError
from scan2albedo.lighting.environment import distant_directions
from scan2albedo.lighting.harmonics import harmonics, project_environment
from scan2albedo.reflectance import light_transfer
from scan2albedo.reflectance.environment_shading import light_response

BALL = distant_directions(1500)
FACES = ConvexHull(BALL).simplices.astype(np.int64)
VIEW = np.tile([0.0, 0.0, 1.0], (len(BALL), 1))
CUP = 80 * BALL * np.where(BALL[:, 2:] > 0.3, -0.5, 1.0)


def nothing(point, toward):
    return np.zeros(len(toward), bool)


def brute_force(point, n, v, hidden, count=10_000):
    """Sum visibility times lobes times harmonics over many directions; `hidden` tells it of directions."""
    toward = distant_directions(count) @ np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    free = ~hidden(point, toward) & (toward @ n > 0)
    return (free * lobes_under(n, v, toward)) @ (harmonics(toward) * (4 * np.pi / count))


def test_a_convex_surface_has_no_shadows():
    transfer = light_transfer(80 * BALL, FACES, BALL, VIEW)
    assert_allclose(transfer.diffuse, light_response(BALL, VIEW).diffuse, atol=1e-12)
    for vertex in (10, 700, 760):
        expected = brute_force(None, BALL[vertex], VIEW[vertex], nothing)
        expected[1:] *= BALL[vertex, 2] > 0
        assert_allclose(transfer.specular[vertex], expected[1:], atol=0.015)
    assert (transfer.specular[BALL[:, 2] < 0] == 0).all()


def test_inside_a_closed_surface_there_is_no_light():
    transfer = light_transfer(80 * BALL, FACES, -BALL, VIEW)
    assert (transfer.diffuse == 0).all()
    assert (transfer.specular == 0).all()


@pytest.mark.slow
def test_shadows_of_a_ball_are_those_of_the_formula(monkeypatch):
    """Vertices of a floor under a ball; where rays meet the ball is known exactly."""
    monkeypatch.setattr("scan2albedo.reflectance.photograph.RAY_OFFSET_MM", 1e-9)
    x, z = (grid.ravel() for grid in np.meshgrid(np.linspace(-60, 60, 4), np.linspace(-60, 60, 4)))
    floor = np.stack([x, np.zeros_like(x), z], 1)
    dense = distant_directions(3000)
    centre = np.array([10.0, 45.0, 5.0])
    radius = 30.0
    vertices = np.vstack([floor, centre + radius * dense])
    n = np.vstack([np.tile([0.0, 1.0, 0.0], (16, 1)), dense])
    v = np.tile(np.array([0.6, 0.8, 0.0]), (len(n), 1))
    transfer = light_transfer(vertices, len(floor) + ConvexHull(dense).simplices, n, v)

    def hidden(point, toward):
        along = toward @ (centre - point)
        return (along > 0) & (np.sum((centre - point) ** 2) - along**2 < radius**2)

    lights = np.stack([project_environment(generated_environment(k)) for k in range(5)], 1).reshape(81, -1)
    off, size, shadow = np.zeros(4), np.zeros(4), np.zeros(4)
    for vertex in range(16):
        truth = brute_force(floor[vertex], n[vertex], v[vertex], hidden) @ lights
        free = brute_force(floor[vertex], n[vertex], v[vertex], nothing) @ lights
        found = np.vstack([transfer.diffuse[vertex], transfer.specular[vertex]]) @ lights
        off += np.sum((found - truth) ** 2, 1)
        size += np.sum(truth**2, 1)
        shadow += np.sum((free - truth) ** 2, 1)
    assert (np.sqrt(off / size) < [0.02, 0.03, 0.02, 0.03]).all()
    assert (np.sqrt(shadow / size) > 0.1).all()


@pytest.mark.slow
@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_neither_unit_nor_place_matters(unit, monkeypatch):
    here = light_transfer(CUP, FACES, BALL, VIEW, directions=256)
    monkeypatch.setattr("scan2albedo.reflectance.photograph.RAY_OFFSET_MM", unit * 0.2)
    shifted = unit * (CUP + [500.0, -300, 200])
    there = light_transfer(shifted, FACES, BALL, VIEW, directions=256)
    assert not np.array_equal(here.diffuse, light_response(BALL, VIEW).diffuse)
    differs = np.abs(here.diffuse - there.diffuse).max(1) > 1e-9
    assert differs.mean() < 0.02


def test_the_same_input_gives_the_same_bits():
    one, two = (light_transfer(CUP, FACES, BALL, VIEW, directions=200) for _ in range(2))
    assert_array_equal(one.diffuse, two.diffuse)
    assert_array_equal(one.specular, two.specular)


def test_vertices_without_a_surface_receive_nothing():
    normals, view = BALL.copy(), VIEW.copy()
    normals[3] = 0.0
    view[3] = np.nan
    transfer = light_transfer(80 * BALL, FACES, normals, view, directions=64)
    assert (transfer.diffuse[3] == 0).all()
    assert (transfer.specular[3] == 0).all()
    assert np.isfinite(transfer.diffuse).all()
    assert np.isfinite(transfer.specular).all()


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"directions": 63}, ValueError, "directions"),
        ({"faces": np.zeros((0, 3), int)}, ReflectanceError, "no triangles"),
        ({"vertices": BALL * np.nan}, ReflectanceError, "finite"),
        ({"normals": 2 * BALL}, ReflectanceError, "length 2"),
        ({"toward_camera": 2 * VIEW}, ReflectanceError, "toward_camera of vertex 0"),
        ({"normals": BALL[:5]}, ValueError, "normals"),
        ({"toward_camera": VIEW[:5]}, ValueError, "toward_camera"),
    ],
)
def test_what_is_no_surface_is_refused(changes, error, words):
    given = {"vertices": BALL, "faces": FACES, "normals": BALL, "toward_camera": VIEW} | changes
    with pytest.raises(error, match=words):
        light_transfer(**given)
