"""Pictures of relit faces: light as the equation says, shadows without steps, holes filled."""

import numpy as np
import trimesh

from scan2albedo.geometry.pinhole import look_at
from scan2albedo.reflectance import VertexReflectance
from scan2albedo.report.reflectance_views import relit_picture

SHAPE = (61, 61)
CAMERA = look_at([0, 0, 500], [0, 0, 0], focal_px=250, shape=SHAPE)


def plate(side=9, half=60.0, height=0.0):
    """A square of side x side vertices that faces +z."""
    ticks = np.linspace(-half, half, side)
    y, x = np.meshgrid(ticks, ticks, indexing="ij")
    vertices = np.stack([x.ravel(), y.ravel(), np.full(side * side, height)], 1)
    row, column = np.mgrid[: side - 1, : side - 1]
    first = (row * side + column).ravel()
    lower = np.stack([first, first + 1, first + side + 1], 1)
    return vertices, np.concatenate([lower, np.stack([first, first + side + 1, first + side], 1)])


def matt(count, albedo=0.5, known=None):
    every = np.ones(count, bool) if known is None else known
    return VertexReflectance(np.full((count, 3), albedo), np.zeros((count, 3)), every)


def test_a_plate_in_front_of_a_light():
    vertices, faces = plate()
    face = (vertices, faces, np.tile([0.0, 0, 1], (len(vertices), 1)), matt(len(vertices)))
    made, known = relit_picture(*face, camera=CAMERA, shape=SHAPE, light=np.array([0.0, 0, 1e6]))
    assert known[10:-10, 10:-10].all()
    assert np.allclose(made[30, 30], 0.5 / np.pi)
    near, _ = relit_picture(
        *face, camera=CAMERA, shape=SHAPE, light=np.array([0.0, 0, 500]), reference_distance_mm=1000
    )
    assert np.allclose(near[30, 30], 4 * 0.5 / np.pi, rtol=1e-3)


def test_the_edge_of_a_shadow_is_straight_and_soft_whatever_the_mesh():
    """Vertices are seven pixels apart; the edge is where it should be to a small part of a pixel."""
    ground, faces = plate()
    small, other = plate(side=2, half=21.0, height=40.0)
    vertices = np.concatenate([ground, small])
    normals = np.tile([0.0, 0, 1], (len(vertices), 1))
    face = (vertices, np.concatenate([faces, other + len(ground)]), normals, matt(len(vertices)))
    made, _ = relit_picture(*face, camera=CAMERA, shape=SHAPE, light=np.array([1000.0, 0, 1000]))
    part = made[10:31, 3:18, 0] / made[10, 3:18, 0]  # left of the plate, from the lit ground to its shadow
    assert part[-1].max() < 0.01
    edge_mm = 21 * 1000 / 960
    lit = part.sum(0)
    assert np.abs(lit - (30 - edge_mm / 2 - 9.5)).max() < 0.25
    assert np.ptp(lit) < 0.1
    assert ((part > 0.1) & (part < 0.9)).any(0).all()


def test_a_coarse_ball_does_not_shadow_itself():
    ball = trimesh.creation.icosphere(subdivisions=2, radius=50)
    normals = ball.vertices / 50
    face = (np.array(ball.vertices), np.array(ball.faces), normals, matt(len(normals)))
    light = np.array([800.0, 0, 500])
    made, _ = relit_picture(*face, camera=CAMERA, shape=SHAPE, light=light)
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    x, y = (columns - 30) * 2.0, (30 - rows) * 2.0
    inside = x**2 + y**2 < 40**2
    normal = np.stack([x, y, np.sqrt(np.maximum(2500 - x**2 - y**2, 0))], -1) / 50
    toward = light - 50 * normal
    cosine = (normal * toward).sum(-1) / np.linalg.norm(toward, axis=-1)
    off = np.abs(made[..., 0] * np.pi / 0.5 - np.maximum(cosine, 0))[inside]
    assert off.max() < 0.12
    assert off.mean() < 0.02


def test_unknown_vertices_are_drawn_and_marked():
    vertices, faces = plate()
    known = np.ones(len(vertices), bool)
    known[40] = False
    one = VertexReflectance(np.where(known[:, None], [0.5] * 3, np.nan), np.zeros((len(known), 3)), known)
    face = (vertices, faces, np.tile([0.0, 0, 1], (len(vertices), 1)), one)
    made, certain = relit_picture(*face, camera=CAMERA, shape=SHAPE, light=np.array([0.0, 0, 1e6]))
    assert np.allclose(made[30, 30], 0.5 / np.pi)
    assert not certain[30, 30]
    assert certain[12, 12]


def test_the_back_of_a_surface_is_not_drawn():
    vertices, faces = plate()
    face = (vertices, faces[:, ::-1], np.tile([0.0, 0, -1], (len(vertices), 1)), matt(len(vertices)))
    made, known = relit_picture(*face, camera=CAMERA, shape=SHAPE, light=np.array([0.0, 0, 1e6]))
    assert (made == 0).all()
    assert not known.any()
