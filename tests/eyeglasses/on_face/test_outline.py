"""Outlines of meshes in pictures, distances to masks, and the search for where a mask ends."""

import numpy as np
import pytest
from helpers.lens_frames import frame_mask
from helpers.plates import FACES
from numpy.testing import assert_allclose
from scipy.ndimage import binary_erosion

from scan2albedo.eyeglasses.on_face.outline import MaskDistance, search_edges, trace_outline
from scan2albedo.geometry.pinhole import look_at
from scan2albedo.rendering.pictures import seen_samples
from scan2albedo.synthetic import eyeglasses

SHAPE = (300, 400)
CAMERA = look_at([150, 60, 500], [0, -5, -20], focal_px=900, shape=SHAPE, roll_rad=0.1)
GLASSES = eyeglasses(2)


@pytest.fixture(scope="module")
def seen():
    return seen_samples(GLASSES.vertices, GLASSES.faces, CAMERA, SHAPE)


def columns_and_rows(seen):
    """Return (N, 2) of each sample."""
    return np.stack(np.divmod(seen.index, SHAPE[1])[::-1], 1)


def test_an_outline_is_where_the_mask_ends_and_looks_outward(seen):
    which, outward = trace_outline(seen)
    shown = frame_mask(GLASSES.vertices, GLASSES.faces, CAMERA, SHAPE)
    assert 3000 < shown.sum() < 30000
    expected = np.flatnonzero(shown & ~binary_erosion(shown))
    assert len(which) >= 0.99 * len(expected)
    assert set(seen.index[which]) <= set(expected)
    ahead = np.round(columns_and_rows(seen)[which] + 3 * outward).astype(int)
    assert (~shown[ahead[:, 1], ahead[:, 0]]).mean() > 0.9
    assert_allclose(np.linalg.norm(outward, axis=1), 1.0)


def test_the_border_of_the_picture_is_no_outline():
    square = np.array([[-50.0, -50, 1], [60, -50, 1], [60, 350, 1], [-50, 350, 1]])
    seen = seen_samples(square, FACES, np.eye(3, 4), SHAPE)
    which, outward = trace_outline(seen)
    column, row = columns_and_rows(seen)[which].T
    assert set(column) == {60}
    inner = (row > 3) & (row < 296)
    assert_allclose(outward[inner], np.tile([1.0, 0], (292, 1)))


def test_a_frame_behind_the_camera_or_beside_the_picture_has_no_outline():
    away = look_at([0, 0, -900], [0, 0, -2000], focal_px=900, shape=SHAPE)
    beside = CAMERA + 2000 * np.array([[1.0], [0], [0]]) * CAMERA[2]
    for camera in (away, beside):
        seen = seen_samples(GLASSES.vertices, GLASSES.faces, camera, SHAPE)
        assert len(seen.index) == len(trace_outline(seen)[0]) == 0


@pytest.fixture(scope="module")
def bar():
    """Distances to a mask of columns 100 to 199, rows 140 to 149."""
    mask = np.zeros(SHAPE, bool)
    mask[140:150, 100:200] = True
    return MaskDistance.of(mask)


def test_distances_are_zero_on_the_outermost_pixels_and_rise_outward_but_far_away_are_not_known(bar):
    rows = [140, 137, 143, 139.5, 145, 145, 20, 3]
    value, slope = bar.sample(np.column_stack([[150, 150, 150, 150, 199, 210, 399, np.nan], rows]))
    assert_allclose(value, [0, 3, -3, 0.5, 0, 11, np.nan, np.nan], atol=1e-6)
    assert_allclose(slope[[1, 2, 3, 5]], [[0, -1], [0, -1], [0, -1], [1, 0]], atol=1e-6)
    assert np.isnan(slope[6:]).all()


def test_the_search_finds_the_end_of_a_bar_but_not_its_side_nor_one_that_is_entered(bar):
    places = np.array([[180.0, 145], [205, 145], [150, 145], [180, 145], [90, 145]])
    outward = np.array([[1.0, 0], [1, 0], [0, -1], [1, 0], [1, 0]])
    found = search_edges(bar, places, outward, np.array([40.0, 40, 40, 10, 30]))
    assert_allclose(found, [19, -6, 5, np.nan, np.nan], atol=0.05)
