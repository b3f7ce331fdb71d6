"""The picture of a scan from the front shows the colour of what is nearest, at its place."""

import numpy as np
import pytest
from helpers.square import SQUARE_FACES as FACES
from helpers.square import SQUARE_UV

from scan2albedo import RawScan
from scan2albedo.geometry.rasterization import front_picture

SQUARE = np.insert(10 * SQUARE_UV, 2, 0, axis=1)
UV = SQUARE_UV[FACES]


def picture(scan, pose=None):
    return front_picture(scan, np.eye(4) if pose is None else pose, np.full(2, -2.0), np.full(2, 12.0), 0.5)


def color_at(shown, x, y):
    column, row = np.round((np.array([x, y]) - shown.low) / shown.step_mm).astype(int)
    return shown.color[row, column] if shown.seen[row, column] else None


def test_a_texture_lies_where_its_points_are():
    texture = np.zeros((20, 20, 3), np.float32)
    texture[:10, :10] = (1.0, 0.5, 0.25)  # the upper left quarter
    shown = picture(RawScan(SQUARE, FACES, uv=UV, texture_linear=texture))
    assert np.allclose(color_at(shown, 2, 8), (1.0, 0.5, 0.25))
    assert np.allclose(color_at(shown, 8, 8), 0)
    assert np.allclose(color_at(shown, 2, 2), 0)
    assert color_at(shown, -1, 5) is None
    shown = picture(RawScan(SQUARE, FACES, uv=UV, texture_linear=texture), np.diag([-1.0, -1, 1, 1]))
    assert not shown.seen[shown.seen.shape[0] // 2 :].any()


@pytest.mark.parametrize("other", [SQUARE + [0, 0, -5], SQUARE * 20 + [-100, -100, 5]])
def test_vertex_colours_of_what_lies_in_front_of_others_and_of_faces_torn_across_the_picture(other):
    colors = np.repeat([[1.0, 0, 0], [0, 1, 0]], 4, axis=0)
    scan = RawScan(
        np.concatenate([SQUARE, other]), np.concatenate([FACES, FACES + 4]), vertex_color_linear=colors
    )
    assert np.allclose(color_at(picture(scan), 5, 5), (1, 0, 0))


def test_faces_that_look_away_are_left_out():
    scan = RawScan(SQUARE, FACES[:, ::-1], vertex_color_linear=np.ones((4, 3)))
    assert not picture(scan).seen.any()


def test_coordinates_of_other_periods_and_at_the_edge_are_those_of_the_texture():
    texture = np.zeros((4, 4, 3), np.float32)
    texture[:, 2:] = 1.0
    plain, moved = (RawScan(SQUARE, FACES, uv=UV + shift, texture_linear=texture) for shift in (0.0, 3.0))
    assert np.allclose(picture(plain).color, picture(moved).color)
    assert np.allclose(color_at(picture(plain), 9.9, 5), 1, atol=0.01)
