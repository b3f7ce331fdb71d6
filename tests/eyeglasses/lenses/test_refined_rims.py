"""Edges of lenses refined by masks, where the mesh's rims lack pieces, beside the true ones."""

import numpy as np
import pytest
from helpers.eyeglasses import outline_distances

from scan2albedo.eyeglasses import find_lens_rim, refine_lens_rim
from scan2albedo.geometry.pinhole import look_at, pixel_directions, pixel_grid
from scan2albedo.synthetic import eyeglasses
from scan2albedo.synthetic.renderer import RayScene

SIZE = 640
GLASSES = eyeglasses(5)
MARKS = GLASSES.keypoints[[i for i, n in enumerate(GLASSES.names) if n.startswith("left_rim")]]
CENTER, TRUTH = GLASSES.lens_centers[0], GLASSES.lens_outlines[0]
CAMERAS = [
    look_at(CENTER + 600 * np.array([np.sin(a), 0.13, np.cos(a)]), CENTER, focal_px=1800, shape=(SIZE, SIZE))
    for a in (-0.6, 0.0, 0.6)
]


@pytest.fixture(scope="module")
def masks():
    scene, seen = RayScene(GLASSES.vertices, GLASSES.faces), []
    for camera in CAMERAS:
        rays = pixel_directions(camera, pixel_grid((SIZE, SIZE)))
        eye = -np.linalg.solve(camera[:, :3], camera[:, 3])
        hit = scene.first_hit(np.broadcast_to(eye, rays.shape), rays)
        seen.append((camera, (hit.face >= 0).reshape(SIZE, SIZE)))
    return seen


def found(kept, scale=1.0):
    given = {"rim_points": scale * MARKS}
    return find_lens_rim(scale * GLASSES.vertices, GLASSES.faces[kept], scale * CENTER, **given)


def faces_of_rim(lost):
    """True for all faces but those of the left rim where the angle around its centre is `lost`."""
    offset = GLASSES.vertices[GLASSES.faces].mean(1) - CENTER
    near = (np.hypot(offset[:, 0], offset[:, 1]) < 40) & (np.abs(offset[:, 2]) < 15)
    return ~(near & lost(np.arctan2(offset[:, 1], offset[:, 0])))


DAMAGE = {
    "half": lambda angle: angle < 0,
    "gaps": lambda angle: np.abs(np.sin(1.5 * angle)) < 0.5,
    "all": lambda angle: np.ones(len(angle), bool),
}


@pytest.mark.parametrize(("damage", "bar_mm"), [("half", 0.6), ("gaps", 0.3), ("all", 1.4)])
def test_masks_show_the_edge_that_the_mesh_lacks(masks, damage, bar_mm):
    rim = found(faces_of_rim(DAMAGE[damage]))
    refined = refine_lens_rim(rim, masks, rim_points=MARKS)
    before, after = (np.sqrt((outline_distances(r.points, TRUTH) ** 2).mean()) for r in (rim, refined))
    assert rim.gaps == "subdivided"
    assert after <= min(bar_mm, 0.7 * before)
    off = outline_distances(refined.points, TRUTH)
    assert (off <= 2 * refined.deviation).mean() >= 0.9
    if damage != "all":
        assert refined.deviation[rim.measured].mean() < 0.7 * refined.deviation[~rim.measured].mean()


def test_a_whole_rim_stays_where_it_was_measured(masks):
    rim = found(np.ones(len(GLASSES.faces), bool))
    refined = refine_lens_rim(rim, masks, rim_points=MARKS)
    assert outline_distances(refined.points, TRUTH).max() <= 0.2


def test_pictures_that_say_nothing_change_nothing(masks):
    rim = found(faces_of_rim(DAMAGE["half"]))
    camera = masks[0][0]
    nothing, everything = np.zeros((SIZE, SIZE)), np.ones((SIZE, SIZE))
    away = camera + np.array([[900.0], [0], [0]]) * camera[2]
    for views in ([], [(camera, nothing)], [(camera, everything)], [(away, masks[0][1])]):
        assert refine_lens_rim(rim, views, rim_points=MARKS) is rim
    # A dark lens covers the opening.
    filled = np.zeros((SIZE, SIZE), bool)
    filled[100:540, 100:540] = True
    assert refine_lens_rim(rim, [(camera, filled)], rim_points=MARKS) is rim


def test_masks_of_other_views_are_left_out(masks):
    rim = found(faces_of_rim(DAMAGE["gaps"]))
    exchanged = [(camera, mask) for (camera, _), (_, mask) in zip(masks, masks[::-1], strict=True)]
    for views in (exchanged, [masks[0], masks[1], (masks[2][0], masks[0][1])]):
        refined = refine_lens_rim(rim, views, rim_points=MARKS)
        assert np.sqrt((outline_distances(refined.points, TRUTH) ** 2).mean()) < 0.3


def test_the_unit_does_not_matter_and_surer_masks_leave_less_open(masks):
    kept = faces_of_rim(DAMAGE["half"])
    metres = [(camera * [1e3, 1e3, 1e3, 1.0], mask) for camera, mask in masks]
    given = refine_lens_rim(found(kept), masks, rim_points=MARKS)
    scaled = refine_lens_rim(found(kept, 1e-3), metres, rim_points=1e-3 * MARKS)
    np.testing.assert_allclose(1e3 * scaled.points, given.points, atol=1e-3)
    surer = refine_lens_rim(found(kept), masks, rim_points=MARKS, deviation_px=0.5)
    assert surer.deviation.mean() < given.deviation.mean()
