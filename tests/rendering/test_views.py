"""The quick pictures show what is there, where it is."""

from types import SimpleNamespace

import numpy as np
import trimesh
from helpers.meshes import grid, sphere
from numpy.testing import assert_array_equal

from scan2albedo import RawScan
from scan2albedo.geometry.mesh import join
from scan2albedo.pipeline.overview import scan_panel
from scan2albedo.rendering.pictures import View, heat_colors, render_mesh
from scan2albedo.report.overview import Panel, overview_picture, preview_srgb


def test_a_sphere_covers_the_disc_it_should():
    picture = render_mesh(*sphere(4, 10.0), view=View((0, 0, 0), 20.0), size=200)
    covered = (picture != 255).any(-1)
    assert abs(covered.mean() - np.pi * 100 / 1600) < 0.01
    assert covered[100, 100]
    assert not covered[5, 5]


def test_yaw_shows_the_right_side_and_pitch_the_underside():
    box = trimesh.creation.box((10, 10, 10))
    for axis, turn in ((0, "yaw_deg"), (1, "pitch_deg")):
        # Colours by vertex: the side at -x, or at -y, red, the others blue.
        color = np.where(box.vertices[:, [axis]] < 0, [1.0, 0, 0], [0, 0, 1.0])
        view = View.around(box.vertices, **{turn: 60})
        picture = render_mesh(
            box.vertices, box.faces, vertex_color_srgb=color, view=view, shaded=False, size=64
        )
        red, blue = picture[..., 0], picture[..., 2]
        assert (red > blue).sum() > (blue > red).sum()


def test_stray_patches_in_front_hide_nothing():
    patch = np.array([[-40, -40, 600.0], [40, -40, 600], [0, 60, 600]])
    vertices, faces = join([sphere(4), (patch, np.array([[0, 1, 2]]))])
    color = np.float32([[0, 0, 1], [1, 0, 0]])[(vertices[:, 2] == 600).astype(int)]
    fitted = SimpleNamespace(model_from_scan=np.eye(4))
    scan = RawScan(vertices, faces, vertex_color_linear=color)
    picture = scan_panel("scan", scan, fitted, View((0, 0, 0), 150.0)).picture
    middle = len(picture) // 2
    assert picture[middle, middle].tolist() == [0, 0, 255]


def test_texture_is_upright():
    square, faces = grid(2, 2)
    uv = square[faces, :2]
    texture = np.zeros((8, 8, 3), np.uint8)
    texture[0, 0] = 255  # top left
    view = View((0.5, 0.5, 0), 0.5)
    picture = render_mesh(square, faces, texture=(uv, texture), view=view, size=80, shaded=False)
    assert (picture[2:8, 2:8] == 255).all()
    assert (picture[70:78, 2:70] == 0).all()


def test_heat_colours_end_where_the_scale_ends_and_mark_missing_values():
    colors = heat_colors([0.0, 1.0, 5.0, np.nan], 0, 1)
    assert_array_equal(colors[1], colors[2])
    assert_array_equal(colors[3], [0.6] * 3)


def test_preview_keeps_hue_and_leaves_room_below_white():
    linear = np.full((4, 4, 3), [0.02, 0.01, 0.005])
    preview = preview_srgb(linear, np.arange(4)[:, None] * np.ones(4) > 0)
    assert (preview[0] == 255).all()
    assert preview[1, 0, 0] == round(255 * (1.055 * 0.55 ** (1 / 2.4) - 0.055))
    assert preview[1, 0, 0] > preview[1, 0, 1] > preview[1, 0, 2]


def test_an_overview_shows_whole_panels_below_its_title():
    panels = [Panel("a long title " * 9, np.full((10, 20, 3), 100, np.uint8)) for _ in range(6)]
    grey = (np.asarray(overview_picture("title " * 99, panels)) == 100).all(-1)
    assert grey.sum() == 6 * 360 * 180
    assert np.diff(grey.any(1).astype(int)).clip(0).sum() == 2
