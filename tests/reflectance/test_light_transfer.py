"""Light with cast shadows: closed forms, sums with shadows known exactly, gaps, bad input."""

from functools import partial

import numpy as np
import pytest
from helpers.lobes import response_by_sums
from numpy.testing import assert_allclose
from scipy.spatial import ConvexHull
from worlds.environments import generated_environment

from scan2albedo.errors import ReflectanceError
from scan2albedo.lighting.environment import distant_directions
from scan2albedo.lighting.harmonics import project_environment
from scan2albedo.reflectance import light_transfer
from scan2albedo.reflectance.environment_shading import light_response

BALL = distant_directions(1500)
FACES = ConvexHull(BALL).simplices.astype(np.int64)
VIEW = np.tile([0.0, 0.0, 1.0], (len(BALL), 1))


def test_a_convex_surface_has_no_shadows():
    transfer = light_transfer(80 * BALL, FACES, BALL, VIEW)
    assert_allclose(transfer.diffuse, light_response(BALL, VIEW).diffuse, atol=1e-12)
    for vertex in (10, 700, 760):
        expected = response_by_sums(BALL[vertex], VIEW[vertex])
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
    up, view = np.array([0.0, 1.0, 0.0]), np.array([0.6, 0.8, 0.0])
    n = np.vstack([np.tile(up, (16, 1)), dense])
    mesh = vertices, len(floor) + ConvexHull(dense).simplices
    transfer = light_transfer(*mesh, n, np.broadcast_to(view, n.shape))

    def hidden(point, toward):
        along = toward @ (centre - point)
        return (along > 0) & (np.sum((centre - point) ** 2) - along**2 < radius**2)

    lights = np.stack([project_environment(generated_environment(k)) for k in range(5)], 1).reshape(81, -1)
    truth = [response_by_sums(up, view, hidden=partial(hidden, point)) for point in floor] @ lights
    found = np.concatenate([transfer.diffuse[:16, None], transfer.specular[:16]], axis=1) @ lights
    free = response_by_sums(up, view) @ lights
    off, shadow = (np.sum((one - truth) ** 2, (0, 2)) / np.sum(truth**2, (0, 2)) for one in (found, free))
    assert (np.sqrt(off) < [0.02, 0.03, 0.02, 0.03]).all()
    assert (np.sqrt(shadow) > 0.1).all()


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
