"""Rasterisation: every texel once, linear functions exact, nearest surface wins."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from scan2albedo.geometry.rasterization import interpolate, pixels_from_uv, rasterize, rasterize_uv


def split_square(seed=0, inner=60):
    """A unit square cut into many irregular triangles."""
    from scipy.spatial import Delaunay

    rng = np.random.default_rng(seed)
    side = np.linspace(0, 1, 9)
    border = [(s, e) for s in side for e in (0, 1)] + [(e, s) for s in side[1:-1] for e in (0, 1)]
    points = np.concatenate([border, rng.uniform(0.02, 0.98, (inner, 2))])
    return points, Delaunay(points).simplices.astype(np.int64)


def inside_by_hand(pixels, faces, row, column):
    """Faces whose closed triangle holds a texel centre: the slow, obvious reference."""
    found = []
    for index, (a, b, c) in enumerate(pixels[faces]):
        crosses = [
            (q[0] - p[0]) * (row - p[1]) - (q[1] - p[1]) * (column - p[0])
            for p, q in ((a, b), (b, c), (c, a))
        ]
        if min(crosses) >= -1e-6 or max(crosses) <= 1e-6:
            found.append(index)
    return found


@pytest.mark.parametrize("size", [1, 7, 64, (20, 33)])
def test_a_covered_square_has_no_gaps(size):
    uv, faces = split_square()
    raster = rasterize_uv(uv, faces, size)
    assert raster.covered.all()
    assert_allclose(raster.barycentric.sum(-1), 1)
    assert raster.barycentric.min() > -1e-8


def test_every_texel_belongs_to_the_face_that_holds_its_centre():
    uv, faces = split_square(1, 15)
    raster = rasterize_uv(uv, faces, 16)
    pixels = pixels_from_uv(uv, (16, 16))
    for row in range(16):
        for column in range(16):
            assert raster.face[row, column] in inside_by_hand(pixels, faces, row, column)


def test_texels_on_a_shared_diagonal_are_neither_lost_nor_doubled():
    pixels = np.array([[0.0, 0], [7, 0], [7, 7], [0, 7]])
    raster = rasterize(pixels, np.zeros(4), [[0, 1, 2], [0, 2, 3]], (8, 8))
    assert raster.covered.all()
    assert set(np.unique(raster.face)) == {0, 1}


def test_interpolation_reproduces_linear_functions_exactly():
    uv, faces = split_square(2)
    raster = rasterize_uv(uv, faces, (24, 40))
    linear = uv @ [[2.0, -1.0], [0.5, 3.0]] + [0.25, -4.0]
    image = interpolate(raster, faces, linear)
    u, v = np.meshgrid((np.arange(40) + 0.5) / 40, 1 - (np.arange(24) + 0.5) / 24)
    expected = np.stack([2 * u + 0.5 * v + 0.25, -u + 3 * v - 4], -1)
    assert_allclose(image, expected, atol=1e-12)


def test_the_nearest_surface_wins_whatever_the_order_or_winding():
    square = np.array([[0.0, 0], [9, 0], [9, 9], [0, 9]])
    pixels = np.concatenate([square, square])
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
    image = interpolate(raster, np.array([[0, 1, 2]]), np.ones(3))
    assert image[~raster.covered].sum() == 0
    assert image[raster.covered].tolist() == [1.0] * int(raster.covered.sum())
