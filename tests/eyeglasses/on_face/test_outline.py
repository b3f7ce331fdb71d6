"""Outlines of meshes in pictures, distances to masks, and the search for where a mask ends."""

import numpy as np
import pytest

from scan2albedo.eyeglasses.on_face.outline import (
    MaskDistance,
    cover,
    covered_points,
    search_edges,
    trace_outline,
)
from scan2albedo.geometry.pinhole import look_at, project
from scan2albedo.geometry.rasterization import rasterize
from scan2albedo.synthetic import eyeglasses

SHAPE = (300, 400)
CAMERA = look_at([150, 60, 500], [0, -5, -20], focal_px=900, shape=SHAPE, roll_rad=0.1)
GLASSES = eyeglasses(2)


@pytest.fixture(scope="module")
def seen():
    pixels, depth = project(CAMERA, GLASSES.vertices)
    coverage = cover(pixels, depth, GLASSES.faces, SHAPE)
    return pixels, depth, coverage


def test_it_covers_what_the_shared_rasteriser_covers(seen):
    pixels, depth, coverage = seen
    expected = rasterize(pixels, 1 / depth, GLASSES.faces, SHAPE)
    mask = coverage >= 0
    assert 3000 < mask.sum() < 30000
    np.testing.assert_array_equal(mask, expected.covered)


def test_points_lie_on_the_rays_of_their_pixels(seen):
    pixels, depth, coverage = seen
    place, face, share = covered_points(coverage, pixels, depth, GLASSES.faces)
    points = np.einsum("nk,nki->ni", share, GLASSES.vertices[GLASSES.faces[face]])
    np.testing.assert_allclose(project(CAMERA, points)[0], place, atol=1e-8)
    assert share.min() > -1e-6


def test_an_outline_is_where_the_mask_ends_and_looks_outward(seen):
    pixels, depth, coverage = seen
    outline = trace_outline(coverage, pixels, depth, GLASSES.faces)
    mask = np.pad(coverage >= 0, 1)
    inner = mask[:-2, 1:-1] & mask[2:, 1:-1] & mask[1:-1, :-2] & mask[1:-1, 2:]
    expected = np.argwhere(mask[1:-1, 1:-1] & ~inner)
    assert len(outline.pixels) >= 0.99 * len(expected)
    assert {tuple(p) for p in outline.pixels[:, ::-1]} <= {tuple(p) for p in expected}
    ahead = np.round(outline.pixels + 3 * outline.outward).astype(int)
    assert (~mask[1:-1, 1:-1][ahead[:, 1], ahead[:, 0]]).mean() > 0.9


def test_the_border_of_the_picture_is_no_outline():
    square = np.array([[-50.0, -50], [60, -50], [60, 350], [-50, 350]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    depth = np.full(4, 100.0)
    coverage = cover(square, depth, faces, SHAPE)
    outline = trace_outline(coverage, square, depth, faces)
    assert set(outline.pixels[:, 0]) == {60}
    inner = (outline.pixels[:, 1] > 3) & (outline.pixels[:, 1] < 296)
    np.testing.assert_allclose(outline.outward[inner], np.tile([1.0, 0], (292, 1)))


def test_a_frame_behind_the_camera_or_beside_the_picture_covers_nothing():
    away = look_at([0, 0, -900], [0, 0, -2000], focal_px=900, shape=SHAPE)
    coverage = cover(*project(away, GLASSES.vertices), GLASSES.faces, SHAPE)
    assert (coverage < 0).all()
    pixels, depth = project(CAMERA, GLASSES.vertices)
    beside = pixels + [2000, 0]
    coverage = cover(beside, depth, GLASSES.faces, SHAPE)
    assert len(trace_outline(coverage, beside, depth, GLASSES.faces).pixels) == 0


def bar():
    """A mask of columns 100 to 199, rows 140 to 149."""
    mask = np.zeros(SHAPE, bool)
    mask[140:150, 100:200] = True
    return mask


def test_distances_are_zero_on_the_outermost_pixels_and_rise_outward():
    value, slope = MaskDistance.of(bar()).sample(
        np.array([[150.0, 140], [150, 137], [150, 143], [150, 139.5], [199, 145], [210, 145]])
    )
    np.testing.assert_allclose(value, [0, 3, -3, 0.5, 0, 11], atol=1e-6)
    np.testing.assert_allclose(slope[[1, 2, 3, 5]], [[0, -1], [0, -1], [0, -1], [1, 0]], atol=1e-6)


def test_distances_far_away_are_not_known():
    value, slope = MaskDistance.of(bar()).sample(np.array([[399.0, 20], [np.nan, 3]]))
    assert np.isnan(value).all()
    assert np.isnan(slope).all()


def test_the_search_finds_the_end_of_a_bar_and_not_its_side():
    distance = MaskDistance.of(bar())
    places = np.array([[180.0, 145], [205, 145], [150, 145], [180, 145]])
    outward = np.array([[1.0, 0], [1, 0], [0, -1], [1, 0]])
    found = search_edges(distance, places, outward, np.array([40.0, 40, 40, 10]))
    np.testing.assert_allclose(found[:3], [19, -6, 5], atol=0.05)
    assert np.isnan(found[3])


def test_the_search_does_not_take_an_end_that_is_entered():
    distance = MaskDistance.of(bar())
    found = search_edges(distance, np.array([[90.0, 145]]), np.array([[1.0, 0]]), np.array([30.0]))
    assert np.isnan(found[0])
