"""Rasterisation: every texel once, linear functions exact, nearest surface wins; means and fillings."""

import numpy as np
import pytest
from helpers.square import SQUARE_FACES as FACES, SQUARE_UV
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import Delaunay
from skimage.transform import resize_local_mean

from scan2albedo import RawScan
from scan2albedo.geometry.rasterization import (
    area_mean,
    filled_smoothly,
    front_picture,
    interpolate,
    pixels_from_uv,
    rasterize,
    rasterize_uv,
)


@pytest.fixture(scope="module")
def split_square():
    """A unit square cut into many irregular triangles."""
    side = np.linspace(0, 1, 9)
    border = [(s, e) for s in side for e in (0, 1)] + [(e, s) for s in side[1:-1] for e in (0, 1)]
    points = np.concatenate([border, np.random.default_rng(0).uniform(0.02, 0.98, (60, 2))])
    return points, Delaunay(points).simplices.astype(np.int64)


@pytest.mark.parametrize("size", [1, 7, 64, (20, 33)])
def test_a_covered_square_has_no_gaps(split_square, size):
    raster = rasterize_uv(*split_square, size)
    assert raster.covered.all()
    assert_allclose(raster.barycentric.sum(-1), 1)
    assert raster.barycentric.min() > -1e-8


def test_texels_on_a_shared_diagonal_are_neither_lost_nor_doubled():
    raster = rasterize(7 * SQUARE_UV, np.zeros(4), FACES, (8, 8))
    assert raster.covered.all()
    assert set(np.unique(raster.face)) == {0, 1}


def test_interpolation_reproduces_linear_functions_exactly(split_square):
    """With weights that are not negative: each texel belongs to a face that holds its centre."""
    uv, faces = split_square
    raster = rasterize_uv(uv, faces, (24, 40))
    assert raster.barycentric.min() > -1e-8
    u, v = np.meshgrid((np.arange(40) + 0.5) / 40, 1 - (np.arange(24) + 0.5) / 24)
    assert_allclose(interpolate(raster, faces, uv), np.stack([u, v], -1), atol=1e-12)


def test_the_nearest_surface_wins_whatever_the_order_or_winding():
    pixels = 9 * np.tile(SQUARE_UV, (2, 1))
    depth = np.r_[np.zeros(4), np.linspace(-1, 1, 4)[[0, 3, 3, 0]]]
    faces = np.array([[0, 1, 2], [0, 2, 3], [6, 5, 4], [7, 6, 4]])
    raster = rasterize(pixels, depth, faces, (10, 10))
    tilted = raster.face >= 2
    assert (tilted[:, 5:]).all()
    assert not tilted[:, :5].any()
    assert (rasterize(pixels, depth, faces[::-1], (10, 10)).face < 2).tolist() == tilted.tolist()


def test_what_lies_outside_is_clipped_and_slivers_are_harmless():
    pixels = np.array([[-50.0, -50], [50, -50], [0, 80], [3, 3], [3, 3], [5, 5], [np.nan, 0]])
    faces = np.array([[0, 1, 2], [3, 4, 5], [3, 5, 6]])
    raster = rasterize(pixels, np.r_[np.zeros(3), np.ones(4)], faces, (6, 6))
    assert (raster.face == 0).all()


def test_texel_centres_follow_the_documented_convention():
    pixels = pixels_from_uv([[0.5 / 4, 1 - 0.5 / 2], [1.0, 0.0]], (2, 4))
    assert_allclose(pixels, [[0, 0], [3.5, 1.5]])


def test_uncovered_texels_are_zero_after_interpolation():
    raster = rasterize([[0.0, 0], [1, 0], [0, 1]], np.zeros(3), [[0, 1, 2]], (4, 4))
    assert raster.covered.sum() == 3
    assert_allclose(interpolate(raster, np.array([[0, 1, 2]]), np.ones(3)), raster.covered)


@pytest.mark.parametrize(
    ("size", "to"),
    [((30, 42), (19, 26)), ((100, 99), (26, 26)), ((5, 7), (5, 3)), ((12, 8), (4, 2)), ((12, 8), (12, 8))],
)
def test_smaller_images_hold_the_means_of_the_areas_that_their_pixels_cover(size, to):
    image = np.random.default_rng(1).random((*size, 3))
    assert_allclose(area_mean(image, to), resize_local_mean(image, to, channel_axis=-1), atol=1e-12)


def test_half_of_a_mask_is_exactly_a_half():
    mask = np.arange(6) < 3
    assert (area_mean(np.tile(mask, (6, 1)), (1, 1)) == 0.5).all()


def test_filling_goes_on_smoothly_and_keeps_what_is_known():
    x = np.linspace(0, 1, 32)
    image = np.repeat((x[:, None] + x)[..., None], 3, axis=2)
    known = np.zeros((32, 32), bool)
    known[4:28, 4:28] = True
    known[12:16, 12:16] = False
    filled = filled_smoothly(np.where(known[..., None], image, 9), known)
    assert_array_equal(filled[known], image[known])
    assert np.abs(filled - image)[12:16, 12:16].max() < 0.1
    assert np.abs(filled - image).max() < 0.4
    # Bands of rows are no bands of columns.
    rng = np.random.default_rng(0)
    tall, some = rng.random((600, 90, 3)), rng.random((600, 90)) < 0.01
    turned = filled_smoothly(tall.swapaxes(0, 1), some.T).swapaxes(0, 1)
    assert_allclose(filled_smoothly(tall, some), turned, atol=1e-6)


SQUARE = np.insert(10 * SQUARE_UV, 2, 0, axis=1)
UV = SQUARE_UV[FACES]


def picture(scan, pose=np.eye(4)):
    return front_picture(scan, pose, np.full(2, -2.0), np.full(2, 12.0), 0.5)


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
