"""Pictures of reflectances show what there is."""

import numpy as np
from helpers.meshes import grid

from scan2albedo.geometry.mesh import join
from scan2albedo.geometry.pinhole import look_at
from scan2albedo.reflectance import MeshReflectance, VertexReflectance
from scan2albedo.report.reflectance_views import (
    albedo_colors,
    draw_in_camera,
    reflectance_panels,
    relit_panels,
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
