"""Edges of lenses refined by masks, where the mesh's rims lack pieces, beside the true ones."""

import numpy as np
import pytest
from helpers.eyeglasses import outline_distances
from helpers.lens_frames import frame_mask, from_lens
from helpers.measures import rms

from scan2albedo.eyeglasses import find_lens_rim, refine_lens_rim
from scan2albedo.eyeglasses.mean_keypoints import RIMS
from scan2albedo.geometry.pinhole import look_at
from scan2albedo.synthetic import eyeglasses

SHAPE = (640, 640)
GLASSES = eyeglasses(5)
MARKS = GLASSES.keypoints[RIMS[0]]
CENTER, TRUTH = GLASSES.lens_centers[0], GLASSES.lens_outlines[0]
CAMERAS = [
    look_at(CENTER + 600 * np.array([np.sin(a), 0.13, np.cos(a)]), CENTER, focal_px=1800, shape=SHAPE)
    for a in (-0.6, 0.0, 0.6)
]


@pytest.fixture(scope="module")
def masks():
    return [(camera, frame_mask(GLASSES.vertices, GLASSES.faces, camera, SHAPE)) for camera in CAMERAS]


def found(lost, scale=1.0):
    """The rim of a frame that lacks the faces of the left rim where the angle around its centre is `lost`."""
    x, y, z = from_lens(GLASSES).T
    near = (np.hypot(x, y) < 40) & (np.abs(z) < 15)
    faces = GLASSES.faces[~(near & DAMAGE[lost](np.arctan2(y, x)))]
    return find_lens_rim(scale * GLASSES.vertices, faces, scale * CENTER, rim_points=scale * MARKS)


def error(rim):
    return rms(outline_distances(rim.points, TRUTH))


DAMAGE = {
    "half": lambda angle: angle < 0,
    "gaps": lambda angle: np.abs(np.sin(1.5 * angle)) < 0.5,
    "all": lambda angle: angle < 4,
    "none": lambda angle: angle > 4,
}


@pytest.mark.parametrize(("damage", "bar_mm"), [("half", 0.6), ("gaps", 0.3), ("all", 1.4)])
def test_masks_show_the_edge_that_the_mesh_lacks(masks, damage, bar_mm):
    rim = found(damage)
    refined = refine_lens_rim(rim, masks, rim_points=MARKS)
    assert rim.gaps == "subdivided"
    assert error(refined) <= min(bar_mm, 0.7 * error(rim))
    off = outline_distances(refined.points, TRUTH)
    assert (off <= 2 * refined.deviation).mean() >= 0.9
    if damage != "all":
        assert refined.deviation[rim.measured].mean() < 0.7 * refined.deviation[~rim.measured].mean()


def test_a_whole_rim_stays_where_it_was_measured(masks):
    refined = refine_lens_rim(found("none"), masks, rim_points=MARKS)
    assert outline_distances(refined.points, TRUTH).max() <= 0.2


def test_pictures_that_say_nothing_change_nothing(masks):
    rim = found("half")
    camera = masks[0][0]
    nothing = np.zeros(SHAPE, bool)
    away = camera + np.array([[900.0], [0], [0]]) * camera[2]
    for views in ([], [(camera, nothing)], [(camera, ~nothing)], [(away, masks[0][1])]):
        assert refine_lens_rim(rim, views, rim_points=MARKS) is rim
    # A dark lens covers the opening.
    nothing[100:540, 100:540] = True
    assert refine_lens_rim(rim, [(camera, nothing)], rim_points=MARKS) is rim


def test_masks_of_other_views_are_left_out(masks):
    rim = found("gaps")
    cameras, shown = zip(*masks, strict=True)
    for taken in ((2, 1, 0), (0, 1, 0)):
        views = [(camera, shown[number]) for camera, number in zip(cameras, taken, strict=True)]
        refined = refine_lens_rim(rim, views, rim_points=MARKS)
        assert error(refined) < 0.3


def test_the_unit_does_not_matter_and_surer_masks_leave_less_open(masks):
    rim = found("half")
    metres = [(camera * [1e3, 1e3, 1e3, 1.0], mask) for camera, mask in masks]
    given = refine_lens_rim(rim, masks, rim_points=MARKS)
    scaled = refine_lens_rim(found("half", 1e-3), metres, rim_points=1e-3 * MARKS)
    np.testing.assert_allclose(1e3 * scaled.points, given.points, atol=1e-3)
    surer = refine_lens_rim(rim, masks, rim_points=MARKS, deviation_px=0.5)
    assert surer.deviation.mean() < given.deviation.mean()
