"""Frames of normal maps: along the texture, split where it is mirrored."""

import numpy as np
from helpers.meshes import grid
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.geometry.mesh import normalized, vertex_normals
from scan2albedo.geometry.tangents import in_tangent_space, tangent_mesh

SQUARE, FACES = grid(3, 2)
SQUARE = SQUARE * [2, 1, 1] - [1, 0, 0]


def frames_of(uv, vertices=SQUARE):
    return tangent_mesh(vertices, FACES, uv, vertex_normals(vertices, FACES))


def test_tangents_follow_u_whatever_its_scale_and_turn():
    turned = np.stack([SQUARE[:, 1] * 0.3, 1 - SQUARE[:, 0] * 7], axis=1)[FACES]
    frames = frames_of(turned)
    assert_allclose(frames.tangents, np.tile([0.0, 1, 0, 1], (6, 1)), atol=1e-12)


def test_a_chart_that_is_mirrored_at_a_line_comes_apart_there():
    """Both halves lie on the same texels, as on faces whose texture serves both sides."""
    frames = frames_of(np.abs(SQUARE[:, :2])[FACES])
    assert len(frames.split.vertex) == 8  # the line's two vertices are there twice
    left = SQUARE[frames.split.vertex[frames.split.faces]].mean(1)[:, 0] < 0
    for side, along, hand in ((left, -1, -1), (~left, 1, 1)):
        at = np.unique(frames.split.faces[side])
        assert_allclose(frames.tangents[at], np.tile([along, 0, 0, hand], (4, 1)), atol=1e-12)
    assert_array_equal(frames.split.vertex[frames.split.faces], FACES)


def test_faces_without_a_place_still_have_frames():
    frames = frames_of(np.zeros((4, 3, 2)))
    assert np.isfinite(frames.tangents).all()
    assert_allclose(np.einsum("ij,ij->i", frames.tangents[:, :3], frames.normals), 0, atol=1e-12)
    assert_allclose(np.linalg.norm(frames.tangents[:, :3], axis=1), 1)


def test_directions_come_back_from_interpolated_frames():
    rng = np.random.default_rng(0)
    normal = rng.normal(size=(50, 3))
    tangent = np.cross(normal, rng.normal(size=(50, 3))) + 0.3 * rng.normal(size=(50, 3))  # oblique
    hand = rng.choice([-1.0, 1.0], 50)
    direction = normalized(rng.normal(size=(50, 3)))
    x, y, z = in_tangent_space(direction, normal, np.column_stack([tangent, 0.7 * hand])).T[..., None]
    n, t = normalized(normal), normalized(tangent)
    again = normalized(x * t + y * hand[:, None] * np.cross(n, t) + z * n)
    assert_allclose(again, direction, atol=1e-9)
