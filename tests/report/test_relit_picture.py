"""Pictures of relit faces: light as the equation says, shadows without steps, holes filled."""

import numpy as np
from helpers.meshes import grid, sphere

from scan2albedo.geometry.mesh import join
from scan2albedo.geometry.pinhole import look_at
from scan2albedo.reflectance import VertexReflectance
from scan2albedo.report.reflectance_views import relit_picture

SHAPE = (61, 61)
CAMERA = look_at([0, 0, 500], [0, 0, 0], focal_px=250, shape=SHAPE)


FAR = np.array([0.0, 0, 1e6])


def plate(side=9, half=60.0, height=0.0):
    """A square of side x side vertices that faces +z."""
    vertices, faces = grid(side, side)
    return (2 * vertices - 1) * [half, half, 0] + [0, 0, height], faces


def picture(vertices, faces, light=FAR, normals=None, known=None, **options):
    """Return the picture of a grey matt face, whose normals are +z unless others are given."""
    count = len(vertices)
    known = np.ones(count, bool) if known is None else known
    normals = np.tile([0.0, 0, 1], (count, 1)) if normals is None else normals
    matt = VertexReflectance(np.where(known[:, None], [0.5] * 3, np.nan), np.zeros((count, 3)), known)
    return relit_picture(
        vertices, faces, normals, matt, camera=CAMERA, shape=SHAPE, light=np.array(light, float), **options
    )


def test_a_plate_in_front_of_a_light():
    made, known = picture(*plate())
    assert known[10:-10, 10:-10].all()
    assert np.allclose(made[30, 30], 0.5 / np.pi)
    near, _ = picture(*plate(), [0, 0, 500], reference_distance_mm=1000)
    assert np.allclose(near[30, 30], 4 * 0.5 / np.pi, rtol=1e-3)


def test_the_edge_of_a_shadow_is_straight_and_soft_whatever_the_mesh():
    """Vertices are seven pixels apart; the edge is where it should be to a small part of a pixel."""
    made, _ = picture(*join([plate(), plate(side=2, half=21.0, height=40.0)]), [1000, 0, 1000])
    part = made[10:31, 3:18, 0] / made[10, 3:18, 0]  # left of the plate, from the lit ground to its shadow
    assert part[-1].max() < 0.01
    edge_mm = 21 * 1000 / 960
    lit = part.sum(0)
    assert np.abs(lit - (30 - edge_mm / 2 - 9.5)).max() < 0.25
    assert np.ptp(lit) < 0.1
    assert ((part > 0.1) & (part < 0.9)).any(0).all()


def test_a_coarse_ball_does_not_shadow_itself():
    vertices, faces = sphere(2, 50.0)
    light = np.array([800.0, 0, 500])
    made, _ = picture(vertices, faces, light, vertices / 50)
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
    made, certain = picture(*plate(), known=np.arange(81) != 40)
    assert np.allclose(made[30, 30], 0.5 / np.pi)
    assert not certain[30, 30]
    assert certain[12, 12]


def test_the_back_of_a_surface_is_not_drawn():
    vertices, faces = plate()
    made, known = picture(vertices, faces[:, ::-1], normals=np.tile([0.0, 0, -1], (81, 1)))
    assert (made == 0).all()
    assert not known.any()
