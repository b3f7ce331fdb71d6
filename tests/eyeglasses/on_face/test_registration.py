"""Glasses registered on a synthetic wearer: the bars, and each extreme by name."""

import numpy as np
import pytest
from helpers.measures import rms, row_lengths
from helpers.wearers import rest_frame, small_wearer
from helpers.worn_frames import register
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.core import Budget
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses import KEY_POINT_NAMES, FaceRegistrationOptions, skin
from scan2albedo.eyeglasses.keypoints import MIRROR
from scan2albedo.eyeglasses.mean_keypoints import BEHIND
from scan2albedo.eyeglasses.on_face import outline
from scan2albedo.eyeglasses.on_face.objective import HeadContact
from scan2albedo.geometry.pinhole import project
from scan2albedo.geometry.rigid import (
    compose,
    invert_rigid,
    random_rotation,
    rotation_from_vector,
    transform_points,
)
from scan2albedo.synthetic import wearer

SMALL = small_wearer(1, 512, 0.5)
"""Half the pixels for the tests that are not about figures."""
FRAME = rest_frame(1)


@pytest.fixture(scope="module")
def plain():
    return register(SMALL)


@pytest.fixture(scope="module")
def worn():
    """The same person in larger pictures."""
    return wearer(1)


def error_mm(found, worn, where):
    """Root mean square distance of the chosen vertices from the truth."""
    return rms(row_lengths(found.vertices - worn.vertices)[where])


def views_of(worn, which):
    """Labels, masks and cameras of some views."""
    return {"keypoints_2d": worn.labels[which], "masks": worn.masks[which], "cameras": worn.cameras[which]}


def told(found, stage):
    """What the plan says of a stage."""
    return " ".join(step.reason for step in found.plan if step.stage == stage)


CASES = {
    # Labels' and masks' noise, outliers a view, missing key points; bars in mm rms of what is visible.
    "exact": ({"label_noise_px": 0, "mask_noise_px": 0}, 0.25),
    "one pixel": ({}, 0.35),
    "four pixels": ({"label_noise_px": 4, "mask_noise_px": 2}, 0.85),
    "three gross outliers a view": ({"outliers": 3}, 0.35),
    "eight key points missing": ({"missing": 8}, 0.35),
    "hair over the temples": ({"hair": True}, 0.40),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("seed", [1, 3])
def test_three_views_place_a_bent_frame(name, seed):
    options, bar = CASES[name]
    worn = wearer(seed, **options)
    found = register(worn)
    assert error_mm(found, worn, worn.seen) <= bar
    assert error_mm(found, worn, found.observed) <= bar
    assert found.depth_observed
    assert found.converged
    errors = row_lengths(found.keypoints - worn.keypoints)
    # Deviations are those of a normal distribution, about; a mask's errors alike over a whole temple are not.
    assert rms(errors) < 2.5 * rms(found.keypoint_deviation) + 0.1
    assert np.median(errors / found.keypoint_deviation) < 2


@pytest.mark.slow
def test_outliers_are_named():
    worn = wearer(1, outliers=3)
    found = register(worn)
    shown = [project(camera, worn.keypoints)[0] for camera in worn.cameras]
    off = row_lengths(worn.labels - shown)
    assert not found.inliers[off > 12].any()
    assert found.inliers[off < 4].all()


def test_the_result_fits_together(plain):
    rest, rigid = SMALL.glasses.rest_vertices, plain.world_from_glasses
    assert_allclose(skin(rest, plain.weights, plain.handle_transforms), plain.vertices, atol=1e-9)
    assert_allclose(rigid[:3, :3] @ rigid[:3, :3].T, np.eye(3), atol=1e-12)
    bent = SMALL.glasses.rest_keypoints + plain.bend
    assert_allclose(transform_points(rigid, bent), plain.keypoints, atol=1e-9)
    assert plain.visible.shape == (3, len(rest))
    # The bend carries no rigid motion of its own.
    assert np.abs(plain.bend.mean(0)).max() < 1e-3


def test_the_trace_counts_evaluations_and_the_plan_tells_the_stages():
    rows = []
    found = register(SMALL, on_progress=rows.append)
    assert tuple(rows) == found.trace.rows
    assert found.trace.stages == ("glasses.pose", "glasses.key_points", "glasses.outlines")
    assert {step.stage for step in found.plan if step.ran} >= set(found.trace.stages)
    assert not found.plan.ran("glasses.weights")
    assert not found.plan.ran("glasses.contact")
    assert found.iterations < 150


def test_a_budget_ends_it_with_the_best_so_far_in_the_same_bits():
    cut = {count: register(SMALL, budget=Budget(evaluations=count)) for count in (1, 14, 200)}
    errors = [error_mm(found, SMALL, SMALL.seen) for found in cut.values()]
    assert [found.converged for found in cut.values()] == [False, False, True]
    # Even one evaluation gives the pose of the triangulated key points.
    assert 12 > errors[0] > errors[1] > errors[2]
    assert not cut[1].observed.any()
    assert told(cut[1], "glasses.unfinished")
    again = register(SMALL, budget=Budget(evaluations=14))
    assert_array_equal(again.vertices, cut[14].vertices)
    assert [row.error for row in again.trace] == [row.error for row in cut[14].trace]


@pytest.mark.parametrize("unit", [1e-3, 1e3], ids=["metres", "micrometres"])
def test_units_do_not_matter(unit, plain):
    vertices, faces, keypoints, weights = FRAME
    found = register(
        SMALL,
        glasses=(unit * vertices, faces, unit * keypoints, weights),
        cameras=SMALL.cameras * [1, 1, 1, unit],
        head=(unit * SMALL.head_vertices, SMALL.head_faces),
    )
    # Labels agree to rounding; a pixel of an outline may fall on the other side of the head's edge.
    assert_allclose(found.vertices / unit, plain.vertices, atol=0.06)
    assert_allclose(found.deviation / unit, plain.deviation, rtol=0.02)
    assert (found.observed != plain.observed).mean() < 0.01


def test_where_the_world_lies_does_not_matter(plain):
    move = compose(random_rotation(np.random.default_rng(5)), [300.0, -200, 900])
    head = transform_points(move, SMALL.head_vertices), SMALL.head_faces
    found = register(SMALL, cameras=SMALL.cameras @ invert_rigid(move), head=head)
    assert_allclose(found.vertices, transform_points(move, plain.vertices), atol=0.05)


@pytest.mark.parametrize(("seed", "view"), [(1, 0), (1, 1), pytest.param(3, 0, marks=pytest.mark.slow)])
def test_one_view_says_that_it_does_not_see_depth(seed, view, monkeypatch):
    monkeypatch.setattr(HeadContact, "__bool__", lambda self: False)
    worn = wearer(seed)
    found = register(worn, **views_of(worn, [view]))
    assert not found.depth_observed
    assert found.unobserved[0] == "depth"
    assert found.depth_deviation > 1
    assert not found.observed.all()
    assert told(found, "glasses.depth")
    # The outline fits all the same: overlap is no evidence.
    assert found.iou[0] > 0.7
    assert error_mm(found, worn, worn.seen) < 4 * rms(found.deviation[worn.seen])


@pytest.mark.slow
def test_one_view_rests_the_frame_on_the_nose(monkeypatch):
    errors, deviations = np.zeros((2, 2)), np.zeros((2, 2))
    for row, seed in enumerate((1, 3)):
        worn = wearer(seed)
        for column, contact in enumerate((True, False)):
            monkeypatch.setattr(HeadContact, "__bool__", lambda self, on=contact: on)
            found = register(worn, **views_of(worn, [1]))
            assert found.plan.ran("glasses.contact") == contact
            errors[row, column] = np.linalg.norm((found.keypoints - worn.keypoints).mean(0))
            deviations[row, column] = found.depth_deviation
    assert (deviations[:, 0] < deviations[:, 1]).all()
    assert errors[:, 0].mean() < 1.0


@pytest.mark.slow
def test_no_label_at_all_but_a_start_goes_by_the_outlines():
    worn = wearer(3)
    start = worn.world_from_glasses @ compose(rotation_from_vector([0.03, 0.05, 0.02]), [3.0, -2, 4])
    found = register(worn, keypoints_2d=np.full_like(worn.labels, np.nan), start=start)
    front = worn.glasses.rest_vertices[:, 2] > -25
    assert error_mm(found, worn, front) < 0.35
    assert not found.plan.ran("glasses.key_points")
    # Temples that were far off may have come to rest wrongly; then it says so.
    errors = row_lengths(found.keypoints - worn.keypoints)
    assert found.keypoints_observed[errors > 4].sum() == 0


@pytest.mark.slow
def test_masks_that_show_a_temple_elsewhere_contradict_it(worn, monkeypatch):
    """A temple's end that nothing pulls back: no labels there, and its outline out of reach."""
    labels = worn.labels.copy()
    labels[:, 8:11] = np.nan
    monkeypatch.setattr(outline, "REACH_PX", 6.0)
    found = register(worn, keypoints_2d=labels)
    assert np.linalg.norm((found.keypoints - worn.keypoints)[10]) > 3
    assert "left_temple_tip" in found.unobserved
    assert told(found, "glasses.contradicted")


def test_a_frame_that_leaves_the_picture_is_unobserved_there(worn):
    shift = np.eye(3)
    shift[:2, 2] = [-330, -60]
    labels = worn.labels + shift[:2, 2]
    labels[(labels < 0).any(2)] = np.nan
    cut = {"masks": worn.masks[:, 60:, 330:], "cameras": shift @ worn.cameras}
    found = register(worn, keypoints_2d=labels, **cut)
    assert 0.5 < found.observed.mean() < 0.95
    assert error_mm(found, worn, found.observed) <= 0.35
    assert "right_temple_tip" in found.unobserved
    assert "left_temple_tip" not in found.unobserved


@pytest.mark.parametrize(("value", "words"), [(False, "is empty"), (True, "covers all")])
def test_a_mask_without_an_edge_does_not_count(value, words, worn):
    masks = worn.masks.copy()
    masks[1] = value
    found = register(worn, masks=masks)
    assert np.isnan(found.iou[1])
    assert np.isnan(found.outline_rms_px[1])
    assert any(f"mask of view 1 {words}" in step.reason for step in found.plan)
    assert error_mm(found, worn, worn.seen) <= 0.35


def test_without_masks_the_labels_decide_and_masks_that_disagree_with_them_are_left_aside(worn):
    found = register(worn, masks=None)
    assert not found.plan.ran("glasses.outlines")
    assert np.isnan(found.iou).all()
    assert error_mm(found, worn, worn.seen) <= 0.6
    inverted = register(worn, masks=~worn.masks)
    assert "disagree" in told(inverted, "glasses.masks")
    assert_array_equal(inverted.vertices, found.vertices)
    assert np.isnan(inverted.iou).all()


@pytest.mark.slow
def test_temples_that_hair_hides_are_reported():
    worn = wearer(3, hair=True)
    found = register(worn)
    hidden = worn.hidden.all(0)
    assert hidden.mean() > 0.05
    assert not found.keypoints_observed[hidden[worn.glasses.keypoint_vertices]].any()
    assert (found.observed & hidden).sum() < 0.2 * hidden.sum()
    assert any("hidden in all views" in step.reason for step in found.plan)


def test_a_rigid_frame_stays_as_it_is():
    found = register(SMALL, options=FaceRegistrationOptions(bend=False))
    moved = transform_points(found.world_from_glasses, SMALL.glasses.rest_vertices)
    assert_allclose(found.vertices, moved, atol=1e-9)
    assert_array_equal(found.bend, 0)


def test_a_frame_without_temples_needs_no_temples():
    """Key points that the frame lacks take no part."""
    vertices, faces, keypoints, weights = FRAME
    kept = ~BEHIND[weights.argmax(1)]
    faces = (np.cumsum(kept) - 1)[faces[kept[faces].all(1)]]
    shares = weights[kept] * ~BEHIND
    shares /= shares.sum(1, keepdims=True)
    marks = np.where(BEHIND[:, None], np.nan, keypoints)
    found = register(SMALL, glasses=(vertices[kept], faces, marks, shares), masks=None)
    assert rms(row_lengths(found.vertices - SMALL.vertices[kept])) < 0.8
    assert_array_equal(np.isnan(found.keypoints).all(1), BEHIND)
    assert not set(found.unobserved) & set(np.array(KEY_POINT_NAMES)[BEHIND])


@pytest.mark.slow
def test_weights_are_solved_where_there_are_none(plain):
    found = register(SMALL, glasses=FRAME[:3])
    assert found.plan.ran("glasses.weights")
    assert_allclose(found.vertices, plain.vertices, atol=0.05)


def test_a_far_start_does_no_harm(plain):
    far = SMALL.world_from_glasses @ compose(rotation_from_vector([0, np.deg2rad(60), 0]), np.zeros(3))
    far[:3, 3] += [0, 0, 150]
    assert_allclose(register(SMALL, start=far).vertices, plain.vertices, atol=1e-9)


VERTICES, FACES, POINTS, WEIGHTS = FRAME


@pytest.mark.parametrize(
    ("changes", "kind", "message"),
    [
        ({"keypoints_2d": np.zeros((3, 19, 2))}, ValueError, r"expected \(3, 20, 2\)"),
        ({"glasses": FRAME[:3], "cameras": np.zeros((2, 3, 4))}, ValueError, "singular"),
        ({"masks": [np.zeros((4, 4))]}, ValueError, "one entry for each of 3"),
        ({"masks": [np.zeros((4, 4, 3))] * 3}, ValueError, r"mask 0 must have shape \(H, W\)"),
        ({"start": np.diag([2.0, 1, 1, 1])}, EyeglassesError, "rigid"),
        (
            {"glasses": (VERTICES, FACES, np.full((20, 3), np.nan), WEIGHTS)},
            EyeglassesError,
            "the glasses: 0 key points",
        ),
        ({"glasses": (*FRAME[:3], 2 * WEIGHTS)}, EyeglassesError, "sum 1"),
        ({"glasses": (VERTICES, FACES[:0], *FRAME[2:])}, EyeglassesError, "the glasses: no faces"),
    ],
)
def test_bad_input_is_refused(changes, kind, message):
    with pytest.raises(kind, match=message):
        register(SMALL, **changes)


def test_labels_in_one_spot_do_not_spoil_the_other_views():
    """(0, 0) is how some labellers say that they do not know."""
    labels = SMALL.labels.copy()
    labels[0] = 0
    found = register(SMALL, keypoints_2d=labels)
    assert error_mm(found, SMALL, SMALL.seen) < 0.6
    assert not found.inliers[0].any()


FLIP = [-1, 1, 1]


@pytest.mark.parametrize(
    "mirrored",
    [
        {"keypoints_2d": SMALL.labels[:, MIRROR]},
        {"glasses": (VERTICES, FACES, POINTS[list(MIRROR)], WEIGHTS[:, MIRROR])},
        {"glasses": (VERTICES * FLIP, FACES, POINTS * FLIP, WEIGHTS)},
    ],
    ids=["labels", "key points", "mesh"],
)
def test_left_and_right_exchanged_is_an_error(mirrored):
    with pytest.raises(EyeglassesError, match="left and right"):
        register(SMALL, head=None, **mirrored)


@pytest.mark.slow
def test_labels_that_do_not_fit_leave_nothing_observed():
    for labels in (SMALL.labels[[2, 1, 0]], SMALL.labels[..., ::-1]):
        found = register(SMALL, keypoints_2d=labels)
        assert not found.observed.any()
        assert not found.depth_observed
        assert told(found, "glasses.misfit")


def test_a_head_turned_inside_out_is_turned_back(worn):
    inside_out, plain = (
        register(worn, **views_of(worn, [1]), head=(worn.head_vertices, worn.head_faces[:, ::turn]))
        for turn in (-1, 1)
    )
    assert_allclose(inside_out.vertices, plain.vertices, atol=0.05)


def test_three_pictures_from_one_place_see_no_depth():
    found = register(SMALL, **views_of(SMALL, [1, 1, 1]), head=None)
    assert not found.depth_observed
