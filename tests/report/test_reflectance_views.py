"""Pictures of reflectances, and of faces in another light: shadows without steps, holes filled."""

import numpy as np
from helpers.meshes import grid, sphere

from scan2albedo.geometry.mesh import join
from scan2albedo.geometry.pinhole import look_at
from scan2albedo.reflectance import MeshReflectance, VertexReflectance
from scan2albedo.report.reflectance_views import (
    albedo_colors,
    draw_in_camera,
    reflectance_panels,
    relit_panels,
    relit_picture,
)

CORNERS, FACES = grid(2, 2)
SQUARE = 100 * CORNERS - [50, 50, 0]


def drawn(vertices, faces, color, size=101):
    """Draw a mesh in a camera that sees 2 mm a pixel, or 1 mm with 201 pixels, at the square."""
    camera = look_at([0, 0, 500], [0, 0, 0], focal_px=500, shape=(size, size))
    return draw_in_camera(camera, (size, size), vertices, faces, color)


def test_a_square_is_drawn_where_the_camera_sees_it():
    color = np.array([[1.0, 0, 0], [0, 1, 0], [1, 0, 0], [0, 1, 0]])
    picture, shown = drawn(SQUARE, FACES, color, 201)
    rows, columns = np.nonzero(shown)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (50, 150, 50, 150)
    assert np.allclose(picture[100, [51, 100, 149], 0], [0.99, 0.5, 0.01], atol=0.02)
    assert (picture[~shown] == 0).all()


def test_the_nearer_surface_hides_the_farther():
    both = join([(SQUARE - [0, 0, 100], FACES), (SQUARE * 0.3, FACES)])
    picture, _ = drawn(*both, np.repeat([[1.0, 1, 1], [0, 0, 1.0]], 4, axis=0))
    assert np.allclose(picture[50, 50], [0, 0, 1])
    assert np.allclose(picture[50, 15], [1, 1, 1])


def test_vertices_behind_the_camera_and_unknown_ones_are_left_out():
    color = np.ones((4, 3))
    color[3] = np.nan
    picture, shown = drawn(SQUARE, FACES, color)
    assert np.isfinite(picture).all()
    # Both triangles have that corner; only the edges opposite to it are known.
    assert shown.mean() < 0.03
    behind = SQUARE.copy()
    behind[1, 2] = 900
    picture, shown = drawn(behind, FACES, np.ones((4, 3)))
    assert shown.any()
    assert not shown[70, 70]


def test_unknown_albedo_is_grey_and_white_is_set():
    colors = albedo_colors(np.array([[0.5, 0.5, 0.5], [np.nan] * 3, [1.0, 0.25, 0.0]]), white=1.0)
    assert np.allclose(colors[1], 0.6)
    assert np.allclose(colors[2], [0.906, 0.485, 0.0], atol=2e-3)  # 0.8 and 0.2, encoded as sRGB


def test_panels_of_faces_nobody_knows_and_of_black_pictures():
    nobody = VertexReflectance(np.full((4, 3), np.nan), np.full((4, 3), np.nan), np.zeros(4, bool))
    panels = reflectance_panels(MeshReflectance(SQUARE, FACES, nobody))
    assert [panel.picture.dtype for panel in panels] == [np.uint8] * 4
    black, hidden = np.zeros((20, 20, 3)), np.zeros((20, 20), bool)
    for shown in (hidden, ~hidden):
        panels = relit_panels("a", black, black, shown, np.ones((20, 20, 3), bool))
        assert all(np.asarray(panel.picture).size for panel in panels)


SHAPE = (61, 61)
CAMERA = look_at([0, 0, 500], [0, 0, 0], focal_px=250, shape=SHAPE)


FAR = np.array([0.0, 0, 1e6])


def plate(side=9, half=60.0, height=0.0):
    """A square of side x side vertices that faces +z."""
    vertices, faces = grid(side, side)
    return (2 * vertices - 1) * [half, half, 0] + [0, 0, height], faces


def relit(vertices, faces, light=FAR, normals=None, known=None, **options):
    """Return the picture of a grey matt face, whose normals are +z unless others are given."""
    count = len(vertices)
    known = np.ones(count, bool) if known is None else known
    normals = np.tile([0.0, 0, 1], (count, 1)) if normals is None else normals
    matt = VertexReflectance(np.where(known[:, None], [0.5] * 3, np.nan), np.zeros((count, 3)), known)
    return relit_picture(
        vertices, faces, normals, matt, camera=CAMERA, shape=SHAPE, light=np.array(light, float), **options
    )


def test_a_plate_in_front_of_a_light():
    made, known = relit(*plate())
    assert known[10:-10, 10:-10].all()
    assert np.allclose(made[30, 30], 0.5 / np.pi)
    near, _ = relit(*plate(), [0, 0, 500], reference_distance_mm=1000)
    assert np.allclose(near[30, 30], 4 * 0.5 / np.pi, rtol=1e-3)


def test_the_edge_of_a_shadow_is_straight_and_soft_whatever_the_mesh():
    """Vertices are seven pixels apart; the edge is where it should be to a small part of a pixel."""
    made, _ = relit(*join([plate(), plate(side=2, half=21.0, height=40.0)]), [1000, 0, 1000])
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
    made, _ = relit(vertices, faces, light, vertices / 50)
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
    made, certain = relit(*plate(), known=np.arange(81) != 40)
    assert np.allclose(made[30, 30], 0.5 / np.pi)
    assert not certain[30, 30]
    assert certain[12, 12]


def test_the_back_of_a_surface_is_not_drawn():
    vertices, faces = plate()
    made, known = relit(vertices, faces[:, ::-1], normals=np.tile([0.0, 0, -1], (81, 1)))
    assert (made == 0).all()
    assert not known.any()
