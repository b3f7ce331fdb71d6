"""Glasses registered on a synthetic wearer: the bars, and each extreme by name."""

from functools import cache

import numpy as np
import pytest
from helpers.wearers import rest_frame
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.core import Budget
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses import (
    KEY_POINT_NAMES,
    FaceRegistrationOptions,
    register_on_face,
    skin,
)
from scan2albedo.eyeglasses.keypoints import MIRROR
from scan2albedo.eyeglasses.on_face import outline
from scan2albedo.eyeglasses.on_face.objective import HeadContact
from scan2albedo.geometry.rigid import random_rotation, rotation_from_vector
from scan2albedo.synthetic import wearer

SMALL = {"picture_size": 512, "focal_px": 900, "label_noise_px": 0.5, "mask_noise_px": 0.5}
"""Half the pixels for the tests that are not about figures."""


@cache
def person(seed, **pictures):
    return wearer(seed, **pictures)


def register(seed, pictures, /, **changes):
    """Register a person's own glasses, with some arguments in place of the person's."""
    worn = person(seed, **pictures)
    given = {
        "keypoints_2d": worn.labels,
        "masks": worn.masks,
        "cameras": worn.cameras,
        "head": (worn.head_vertices, worn.head_faces),
    }
    return register_on_face(rest_frame(seed), **{**given, **changes})


@cache
def plain(seed, **pictures):
    """Register a person's own glasses once."""
    return register(seed, pictures)


def error_mm(found, worn, where):
    """Root mean square distance of the chosen vertices from the truth."""
    return float(np.sqrt((np.linalg.norm(found.vertices - worn.vertices, axis=1)[where] ** 2).mean()))


def views_of(worn, which):
    """Labels, masks and cameras of some views."""
    return {"keypoints_2d": worn.labels[which], "masks": worn.masks[which], "cameras": worn.cameras[which]}


CASES = {
    # Labels' and masks' noise, outliers a view, missing key points; bars in mm rms of what is visible.
    "exact": ({"label_noise_px": 0, "mask_noise_px": 0}, 0.25),
    "one pixel": ({}, 0.35),
    "four pixels": ({"label_noise_px": 4, "mask_noise_px": 2}, 0.85),
    "three gross outliers a view": ({"outliers": 3}, 0.35),
    "eight key points missing": ({"missing": 8}, 0.35),
    "hair over the temples": ({"hair": True}, 0.40),
}


QUICK = ("one pixel", "three gross outliers a view")


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in CASES]
)
@pytest.mark.parametrize("seed", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_three_views_place_a_bent_frame(name, seed):
    options, bar = CASES[name]
    worn, found = person(seed, **options), plain(seed, **options)
    assert error_mm(found, worn, worn.seen) <= bar
    assert error_mm(found, worn, found.observed) <= bar
    assert found.depth_observed
    assert found.converged
    errors = np.linalg.norm(found.keypoints - worn.keypoints, axis=1)
    # Deviations are those of a normal distribution, about; a mask's errors alike over a whole temple are not.
    assert np.sqrt((errors**2).mean()) < 2.5 * np.sqrt((found.keypoint_deviation**2).mean()) + 0.1
    assert np.median(errors / found.keypoint_deviation) < 2


@pytest.mark.slow
def test_outliers_are_named():
    worn, found = person(1, outliers=3), plain(1, outliers=3)
    off = np.linalg.norm(worn.labels - projected(worn), axis=2)
    labelled = np.isfinite(off)
    assert_array_equal(found.inliers[labelled & (off > 12)], False)
    assert found.inliers[labelled & (off < 4)].all()


def projected(worn):
    image = np.einsum("cij,kj->cki", worn.cameras[:, :, :3], worn.keypoints) + worn.cameras[:, None, :, 3]
    return image[..., :2] / image[..., 2:]


def test_the_result_fits_together():
    worn, found = person(1, **SMALL), plain(1, **SMALL)
    rest = worn.glasses.rest_vertices
    assert_allclose(skin(rest, found.weights, found.handle_transforms), found.vertices, atol=1e-9)
    rigid = found.world_from_glasses
    assert_allclose(rigid[:3, :3] @ rigid[:3, :3].T, np.eye(3), atol=1e-12)
    bent = worn.glasses.rest_keypoints + found.bend
    assert_allclose(bent @ rigid[:3, :3].T + rigid[:3, 3], found.keypoints, atol=1e-9)
    assert found.visible.shape == (3, len(rest))
    # The bend carries no rigid motion of its own.
    assert np.abs(found.bend.mean(0)).max() < 1e-3


def test_the_trace_counts_evaluations_and_the_plan_tells_the_stages():
    rows = []
    found = register(1, SMALL, on_progress=rows.append)
    assert tuple(rows) == found.trace.rows
    assert found.trace.stages == ("glasses.pose", "glasses.key_points", "glasses.outlines")
    assert {step.stage for step in found.plan if step.ran} >= set(found.trace.stages)
    assert not found.plan.ran("glasses.weights")
    assert not found.plan.ran("glasses.contact")
    assert found.iterations < 150


def test_the_same_input_gives_the_same_bits():
    first, second = (register(1, SMALL, budget=Budget(evaluations=12)) for _ in range(2))
    assert_array_equal(first.vertices, second.vertices)
    assert [(r.evaluations, r.error) for r in first.trace] == [(r.evaluations, r.error) for r in second.trace]


def test_a_budget_ends_it_with_the_best_so_far():
    worn = person(1, **SMALL)
    errors = []
    short = register(1, SMALL, budget=Budget(evaluations=1))
    assert not short.observed.any()
    assert any(step.stage == "glasses.unfinished" for step in short.plan)
    for evaluations in (1, 14, 200):
        found = register(1, SMALL, budget=Budget(evaluations=evaluations))
        errors.append(error_mm(found, worn, worn.seen))
        assert found.converged == (evaluations == 200)
        assert np.isfinite(found.vertices).all()
    assert errors[0] > errors[1] > errors[2]
    # Even one evaluation gives the pose of the triangulated key points.
    assert errors[0] < 12


@pytest.mark.parametrize("unit", [1e-3, 1e3], ids=["metres", "micrometres"])
def test_units_do_not_matter(unit):
    worn, expected = person(1, **SMALL), plain(1, **SMALL)
    vertices, faces, keypoints, weights = rest_frame(1)
    found = register_on_face(
        (unit * vertices, faces, unit * keypoints, weights),
        worn.labels,
        worn.masks,
        worn.cameras @ np.diag([1 / unit, 1 / unit, 1 / unit, 1]),
        head=(unit * worn.head_vertices, worn.head_faces),
    )
    # Labels agree to rounding; a pixel of an outline may fall on the other side of the head's edge.
    assert_allclose(found.vertices / unit, expected.vertices, atol=0.06)
    assert_allclose(found.deviation / unit, expected.deviation, rtol=0.02)
    assert (found.observed != expected.observed).mean() < 0.01
    labels = register_on_face(
        (unit * vertices, faces, unit * keypoints, weights),
        worn.labels,
        None,
        worn.cameras @ np.diag([1 / unit, 1 / unit, 1 / unit, 1]),
    )
    assert_allclose(labels.vertices / unit, register(1, SMALL, masks=None, head=None).vertices, atol=1e-6)


def test_where_the_world_lies_does_not_matter():
    worn, expected = person(1, **SMALL), plain(1, **SMALL)
    move = np.eye(4)
    move[:3, :3] = random_rotation(np.random.default_rng(5))
    move[:3, 3] = [300.0, -200, 900]
    cameras = worn.cameras @ np.linalg.inv(move)
    head = worn.head_vertices @ move[:3, :3].T + move[:3, 3]
    found = register(1, SMALL, cameras=cameras, head=(head, worn.head_faces))
    back = (found.vertices - move[:3, 3]) @ move[:3, :3]
    assert_allclose(back, expected.vertices, atol=0.05)


@pytest.mark.parametrize(("seed", "view"), [(1, 0), (1, 1), pytest.param(3, 0, marks=pytest.mark.slow)])
def test_one_view_says_that_it_does_not_see_depth(seed, view, monkeypatch):
    monkeypatch.setattr(HeadContact, "__bool__", lambda self: False)
    worn = person(seed)
    one = views_of(worn, [view])
    found = register(seed, {}, **one)
    assert not found.depth_observed
    assert found.unobserved[0] == "depth"
    assert found.depth_deviation > 1
    assert not found.observed.all()
    assert any(step.stage == "glasses.depth" for step in found.plan)
    # The outline fits all the same: overlap is no evidence.
    assert found.iou[0] > 0.7
    error = error_mm(found, worn, worn.seen)
    assert error < 4 * np.sqrt((found.deviation[worn.seen] ** 2).mean())


@pytest.mark.slow
def test_one_view_rests_the_frame_on_the_nose(monkeypatch):
    errors, deviations = np.zeros((2, 2)), np.zeros((2, 2))
    for row, seed in enumerate((1, 3)):
        worn = person(seed)
        one = views_of(worn, [1])
        for column, contact in enumerate((True, False)):
            monkeypatch.setattr(HeadContact, "__bool__", lambda self, on=contact: on)
            found = register(seed, {}, **one)
            assert found.plan.ran("glasses.contact") == contact
            errors[row, column] = np.linalg.norm((found.keypoints - worn.keypoints).mean(0))
            deviations[row, column] = found.depth_deviation
    assert (deviations[:, 0] < deviations[:, 1]).all()
    assert errors[:, 0].mean() < 1.0


@pytest.mark.slow
def test_no_label_at_all_but_a_start_goes_by_the_outlines():
    worn = person(3)
    start = worn.world_from_glasses.copy()
    start[:3, :3] = start[:3, :3] @ rotation_from_vector([0.03, 0.05, 0.02])
    start[:3, 3] += [3, -2, 4]
    found = register(3, {}, keypoints_2d=np.full_like(worn.labels, np.nan), start=start)
    front = worn.glasses.rest_vertices[:, 2] > -25
    assert error_mm(found, worn, front) < 0.35
    assert not found.plan.ran("glasses.key_points")
    # Temples that were far off may have come to rest wrongly; then it says so.
    errors = np.linalg.norm(found.keypoints - worn.keypoints, axis=1)
    assert found.keypoints_observed[errors > 4].sum() == 0


@pytest.mark.slow
def test_masks_that_show_a_temple_elsewhere_contradict_it(monkeypatch):
    """A temple's end that nothing pulls back: no labels there, and its outline out of reach."""
    worn = person(1)
    temple = [KEY_POINT_NAMES.index(f"left_{n}") for n in ("temple_middle", "ear_bend", "temple_tip")]
    labels = worn.labels.copy()
    labels[:, temple] = np.nan
    monkeypatch.setattr(outline, "REACH_PX", 6.0)
    found = register(1, {}, keypoints_2d=labels)
    errors = np.linalg.norm(found.keypoints - worn.keypoints, axis=1)
    assert errors[temple[2]] > 3
    assert "left_temple_tip" in found.unobserved
    assert any(step.stage == "glasses.contradicted" for step in found.plan)


def test_a_frame_that_leaves_the_picture_is_unobserved_there():
    worn = person(1)
    shift = np.eye(3)
    shift[:2, 2] = [-330, -60]
    labels = worn.labels + shift[:2, 2]
    labels[(labels < 0).any(2)] = np.nan
    found = register(
        1,
        {},
        keypoints_2d=labels,
        cameras=shift @ worn.cameras,
        masks=[mask[60:, 330:] for mask in worn.masks],
    )
    assert 0.5 < found.observed.mean() < 0.95
    assert error_mm(found, worn, found.observed) <= 0.35
    assert "right_temple_tip" in found.unobserved
    assert "left_temple_tip" not in found.unobserved


@pytest.mark.parametrize(("value", "words"), [(False, "is empty"), (True, "covers all")])
def test_a_mask_without_an_edge_does_not_count(value, words):
    worn = person(1)
    masks = [worn.masks[0], np.full_like(worn.masks[1], value), worn.masks[2]]
    found = register(1, {}, masks=masks)
    assert np.isnan(found.iou[1])
    assert np.isnan(found.outline_rms_px[1])
    assert any(f"mask of view 1 {words}" in step.reason for step in found.plan)
    assert error_mm(found, worn, worn.seen) <= 0.35


def test_without_masks_the_labels_decide():
    worn, found = person(1), register(1, {}, masks=None)
    assert not found.plan.ran("glasses.outlines")
    assert np.isnan(found.iou).all()
    assert error_mm(found, worn, worn.seen) <= 0.6


@pytest.mark.slow
def test_temples_that_hair_hides_are_reported():
    options = {"hair": True}
    worn, found = person(3, **options), plain(3, **options)
    hidden = worn.hidden.all(0)
    assert hidden.mean() > 0.05
    marks = worn.glasses.keypoint_vertices
    assert not found.keypoints_observed[hidden[marks]].any()
    assert (found.observed & hidden).sum() < 0.2 * hidden.sum()
    assert any("hidden in all views" in step.reason for step in found.plan)


def test_a_rigid_frame_stays_as_it_is():
    found = register(1, SMALL, options=FaceRegistrationOptions(bend=False))
    vertices = person(1, **SMALL).glasses.rest_vertices
    moved = vertices @ found.world_from_glasses[:3, :3].T + found.world_from_glasses[:3, 3]
    assert_allclose(found.vertices, moved, atol=1e-9)
    assert_array_equal(found.bend, 0)


def test_a_frame_without_temples_needs_no_temples():
    """Key points that the frame lacks take no part."""
    worn = person(1, **SMALL)
    vertices, faces, keypoints, weights = rest_frame(1)
    lacking = np.array(["temple" in name or "ear" in name for name in KEY_POINT_NAMES])
    kept = ~lacking[weights.argmax(1)]
    number = np.cumsum(kept) - 1
    faces = number[faces[kept[faces].all(1)]]
    shares = weights[kept] * ~lacking
    shares /= shares.sum(1, keepdims=True)
    marks = np.where(lacking[:, None], np.nan, keypoints)
    found = register_on_face(
        (vertices[kept], faces, marks, shares),
        worn.labels,
        None,
        worn.cameras,
        head=(worn.head_vertices, worn.head_faces),
    )
    errors = np.linalg.norm(found.vertices - worn.vertices[kept], axis=1)
    assert np.sqrt((errors**2).mean()) < 0.8
    assert_array_equal(np.isnan(found.keypoints).all(1), lacking)
    assert not set(found.unobserved) & {n for n, gone in zip(KEY_POINT_NAMES, lacking, strict=True) if gone}


@pytest.mark.slow
def test_weights_are_solved_where_there_are_none():
    worn = person(1, **SMALL)
    glasses = worn.glasses
    found = register_on_face(
        (glasses.rest_vertices, glasses.faces, glasses.rest_keypoints),
        worn.labels,
        worn.masks,
        worn.cameras,
        head=(worn.head_vertices, worn.head_faces),
    )
    assert found.plan.ran("glasses.weights")
    assert_allclose(found.vertices, plain(1, **SMALL).vertices, atol=0.05)


def test_a_far_start_does_no_harm():
    worn, expected = person(1, **SMALL), plain(1, **SMALL)
    far = worn.world_from_glasses.copy()
    far[:3, :3] = far[:3, :3] @ rotation_from_vector([0, np.deg2rad(60), 0])
    far[:3, 3] += [0, 0, 150]
    assert_allclose(register(1, SMALL, start=far).vertices, expected.vertices, atol=1e-9)


BAD = {
    "labels of another shape": ({"keypoints_2d": np.zeros((3, 19, 2))}, ValueError, r"expected \(3, 20, 2\)"),
    "a camera too few": ({"cameras": np.zeros((2, 3, 4))}, ValueError, "singular"),
    "a mask too few": ({"masks": [np.zeros((4, 4))]}, ValueError, "one entry for each of 3"),
    "a mask with colours": (
        {"masks": [np.zeros((4, 4, 3))] * 3},
        ValueError,
        r"mask 0 must have shape \(H, W\)",
    ),
    "an empty head": (
        {"head": (np.zeros((0, 3)), np.zeros((0, 3), int))},
        EyeglassesError,
        "the head: vertices hold nothing",
    ),
    "a start that stretches": ({"start": np.diag([2.0, 1, 1, 1])}, EyeglassesError, "rigid"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_refused(name):
    changes, kind, message = BAD[name]
    with pytest.raises(kind, match=message):
        register(1, SMALL, **changes)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (
            lambda g: (np.where(np.arange(len(g[0]))[:, None] == 7, np.nan, g[0]), *g[1:]),
            r"the glasses: vertices: .* first at \[7, 0\]",
        ),
        (lambda g: (*g[:2], np.full((20, 3), np.nan), g[3]), "the glasses: 0 key points"),
        (lambda g: (*g[:3], 2 * g[3]), "sum 1"),
        (lambda g: (g[0], g[1][:0], *g[2:]), "the glasses: no faces"),
    ],
)
def test_bad_glasses_are_refused(spoil, message):
    worn = person(1, **SMALL)
    with pytest.raises(EyeglassesError, match=message):
        register_on_face(spoil(rest_frame(1)), worn.labels, worn.masks, worn.cameras)


def test_labels_in_one_spot_do_not_spoil_the_other_views():
    """(0, 0) is how some labellers say that they do not know."""
    worn = person(1, **SMALL)
    labels = worn.labels.copy()
    labels[0] = 0
    found = register(1, SMALL, keypoints_2d=labels)
    assert error_mm(found, worn, worn.seen) < 0.6
    assert not found.inliers[0].any()


MIRRORED = {
    "labels": lambda worn, frame: (worn.labels[:, MIRROR], frame),
    "key points": lambda worn, frame: (
        worn.labels,
        (*frame[:2], frame[2][list(MIRROR)], frame[3][:, list(MIRROR)]),
    ),
    "mesh": lambda worn, frame: (
        worn.labels,
        (frame[0] * [-1, 1, 1], frame[1], frame[2] * [-1, 1, 1], frame[3]),
    ),
}


@pytest.mark.parametrize("name", MIRRORED)
@pytest.mark.parametrize("masked", [False, True])
def test_left_and_right_exchanged_is_an_error(name, masked):
    worn = person(1, **SMALL)
    labels, frame = MIRRORED[name](worn, rest_frame(1))
    with pytest.raises(EyeglassesError, match="left and right"):
        register_on_face(frame, labels, worn.masks if masked else None, worn.cameras)


@pytest.mark.slow
def test_labels_that_do_not_fit_leave_nothing_observed():
    worn = person(1, **SMALL)
    for labels in (worn.labels[[2, 1, 0]], worn.labels[..., ::-1]):
        found = register(1, SMALL, keypoints_2d=labels)
        assert not found.observed.any()
        assert not found.depth_observed
        assert any(step.stage == "glasses.misfit" for step in found.plan)


def test_masks_that_disagree_with_good_labels_are_left_aside():
    worn = person(1)
    found = register(1, {}, masks=[~mask for mask in worn.masks])
    assert any(step.stage == "glasses.masks" and "disagree" in step.reason for step in found.plan)
    assert_array_equal(found.vertices, register(1, {}, masks=None).vertices)
    assert np.isnan(found.iou).all()


def test_a_head_turned_inside_out_is_turned_back():
    worn = person(1)
    one = views_of(worn, [1])
    inside_out = (worn.head_vertices, worn.head_faces[:, ::-1])
    assert_allclose(
        register(1, {}, **one, head=inside_out).vertices, register(1, {}, **one).vertices, atol=0.05
    )


def test_three_pictures_from_one_place_see_no_depth():
    found = register(1, SMALL, **views_of(person(1, **SMALL), [1, 1, 1]), head=None)
    assert not found.depth_observed
