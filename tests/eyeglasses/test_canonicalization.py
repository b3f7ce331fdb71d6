"""Frames brought to the mean of their key points against the truth; sets, units, budgets."""

import time
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from helpers.canonical_frames import GivenFrame, canonical
from helpers.eyeglasses import nearest_weights
from helpers.measures import rms, row_lengths
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.core import Budget
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses import (
    KEY_POINT_NAMES,
    CanonicalizationOptions,
    bounded_biharmonic_weights,
    canonicalize,
    skin,
)
from scan2albedo.eyeglasses.keypoints import MIRROR
from scan2albedo.eyeglasses.mean_keypoints import front_width
from scan2albedo.geometry.rigid import procrustes, transform_points
from scan2albedo.synthetic import GlassesBend, eyeglasses

SMALL = {
    "spread": GlassesBend(temple_spread_mm=8),
    "closed": GlassesBend(temple_spread_mm=-8),
    "wrapped": GlassesBend(temple_spread_mm=8, bridge_deg=2),
    "opened": GlassesBend(temple_spread_mm=8, bridge_deg=-2),
    "twisted": GlassesBend(twist_deg=3),
}
MEAN = CanonicalizationOptions(mode="mean")
SKIPPING = CanonicalizationOptions(skip_failed=True)
COARSE = {"weights": None, "spacing": 3.0, "options": MEAN}
TRANSLATED = CanonicalizationOptions(mode="mean", handles="translated")


@cache
def weighted(bend, welded=True, seed=0):
    """A synthetic frame, and what is given of it, with weights."""
    glasses = eyeglasses(seed, bend=bend, welded=welded)
    weights = bounded_biharmonic_weights(glasses.vertices, glasses.faces, glasses.keypoints, 3.0)
    return glasses, GivenFrame.of(glasses, weights).posed(seed + 1)


def error_and_result(glasses, given, options=MEAN):
    """Distances of a posed frame from the unbent one, whose key points are the mean, and what is found."""
    result = canonical([given], mean_keypoints=glasses.rest_keypoints, options=options)
    assert_allclose(result.mean_keypoints, glasses.rest_keypoints, atol=1e-9)
    (found,) = result.frames
    return row_lengths(found.vertices - glasses.rest_vertices), found


@pytest.mark.parametrize("welded", [True, False])
@pytest.mark.parametrize("name", SMALL)
def test_a_small_bend_is_undone_by_turning_key_points_better_than_by_shifts(name, welded):
    glasses, given = weighted(SMALL[name], welded)
    error, found = error_and_result(glasses, given)
    assert rms(error) <= 0.15
    assert error.max() <= 0.6
    assert np.abs(found.vertices[glasses.keypoint_vertices] - glasses.rest_keypoints).max() <= 1e-9
    shifted, frame = error_and_result(glasses, given, TRANSLATED)
    assert rms(error) < 0.7 * rms(shifted)
    # The paper's shifts, in closed form.
    aligned, points = (
        transform_points(frame.canonical_from_frame, part) for part in (given.vertices, given.keypoints)
    )
    shifts = glasses.rest_keypoints - points
    assert_allclose(frame.vertices, aligned + given.weights @ shifts, atol=1e-9)


@pytest.mark.slow
def test_an_extreme_bend_stays_near():
    error, _ = error_and_result(*weighted(GlassesBend(temple_spread_mm=40, bridge_deg=10)))
    assert rms(error) < 0.7
    assert error.max() < 2.2


def some_set():
    return [weighted(SMALL[name], seed=k)[1] for k, name in enumerate(("spread", "twisted", "closed"))]


@pytest.mark.slow
def test_a_set_meets_at_its_mean_whatever_its_poses_and_order():
    frames = some_set()
    result = canonical(frames, options=MEAN)
    assert result.converged
    assert not result.plan.ran("eyeglasses.units")
    for frame, given in zip(result.frames, frames, strict=True):
        carried = skin(given.keypoints, np.eye(20), frame.handle_transforms)
        assert_allclose(carried, result.mean_keypoints, atol=1e-9)
        assert 0.5 < frame.residual < 15
    back = canonical([given.posed(9) for given in frames[::-1]], options=MEAN)
    assert_allclose(back.mean_keypoints, result.mean_keypoints, atol=1e-8)
    assert_allclose(back.frames[2].vertices, result.frames[0].vertices, atol=1e-8)
    at = dict(zip(KEY_POINT_NAMES, result.mean_keypoints, strict=True))
    assert at["left_hinge"][0] > 50 > -50 > at["right_hinge"][0]
    assert at["left_hinge"][2] > at["left_temple_tip"][2] + 100
    assert at["bridge_top"][1] > at["bridge_bottom"][1]


def test_plan_and_result_name_widths_of_the_meshes_and_single_bridges():
    frames = []
    for seed in range(2):
        glasses = eyeglasses(seed, double_bridge=seed == 1)
        frames.append(GivenFrame.of(glasses, nearest_weights(glasses.vertices, glasses.keypoints)))
    mixed = canonical(frames, options=MEAN)
    (row,) = mixed.plan.of_stage("eyeglasses.bridges")
    assert row.level == "doubt"
    assert row.reason.startswith("frame 0: one bridge, while other frames")
    assert "leave bridge_top out" in row.reason
    wide = [f"{front_width(frame.keypoints, frame.vertices):.4g}" for frame in frames]
    assert mixed.plan.of_stage("eyeglasses.units")[0].evidence == f"fronts {', '.join(wide)} wide"
    assert not len(canonical(frames).plan.of_stage("eyeglasses.bridges"))
    alone = canonical(frames[:1], options=MEAN)
    assert not len(alone.plan.of_stage("eyeglasses.bridges"))
    assert alone.plan.of_stage("eyeglasses.mean")[0].reason == "mean of 1 frame"


def test_the_mean_of_one_shape_in_many_poses_is_that_shape():
    glasses, given = weighted(GlassesBend())
    result = canonical([given.posed(seed) for seed in range(3)])
    same = transform_points(procrustes(glasses.keypoints, result.mean_keypoints), glasses.keypoints)
    assert_allclose(result.mean_keypoints, same, atol=1e-9)
    assert_allclose(result.mean_keypoints[list(MIRROR)], result.mean_keypoints * [-1, 1, 1], atol=1e-9)
    for frame in result.frames:
        assert frame.residual < 1e-9
        assert_allclose(frame.vertices, result.frames[0].vertices, atol=1e-9)


def test_other_units_are_brought_to_one():
    frames = some_set()

    def scaled(*factors):
        return canonical([frame.scaled(s) for s, frame in zip(factors, frames, strict=True)])

    plain, mixed, in_metres = scaled(1, 1, 1), scaled(1, 1e-3, 1e3), scaled(1e-3, 1e-3, 1e-3)
    assert mixed.plan.ran("eyeglasses.units")
    assert_allclose([f.scale for f in mixed.frames], [1, 1e3, 1e-3])
    for a, b in zip(mixed.frames, plain.frames, strict=True):
        assert_allclose(a.vertices, b.vertices, atol=1e-8)
    back = mixed.frames[1].uncanonicalize(mixed.frames[1].vertices)
    assert_allclose(back, 1e-3 * frames[1].vertices, atol=1e-11)
    assert not in_metres.plan.ran("eyeglasses.units")
    assert_allclose(1e3 * in_metres.mean_keypoints, plain.mean_keypoints, atol=1e-8)


def test_a_frame_of_no_width_of_spectacles_is_refused():
    frames = some_set()
    small = frames[1].scaled(1 / 73)
    given = [frames[0], small, frames[2]]
    with pytest.raises(EyeglassesError, match=r"frame 1: its front is [\d.]+ units wide.*110 to 170 mm"):
        canonical(given)
    rest = canonical(given, options=SKIPPING)
    assert rest.numbers == (0, 2)
    assert "units wide" in rest.failures[1]
    assert_array_equal(rest.mean_keypoints, canonical(frames[::2]).mean_keypoints)
    # A child's frame, which the caller vouches for.
    admitted = CanonicalizationOptions(widths_mm=(90.0, 170.0))
    child = canonical([frames[0].scaled(0.72)], options=admitted)
    assert child.frames[0].scale == 1.0
    with pytest.raises(EyeglassesError, match="mean_keypoints: its front"):
        canonical(frames[:1], mean_keypoints=small.keypoints)


def test_outliers_of_a_set_are_named():
    frames = 2 * some_set()
    assert canonical(frames).outliers == {}
    frames[4] = frames[4].scaled(0.8)
    found = canonical(frames)
    assert sorted(found.outliers) == [4]
    assert "wide, the median of the set is" in found.outliers[4]
    (step,) = found.plan.of_stage("eyeglasses.outliers")
    assert step.level == "doubt"
    assert step.reason.startswith("frame 4 is unlike the others: its front is")


def test_missing_key_points_are_done_without():
    _, given = weighted(SMALL["spread"])
    gaps = [1, 5, 12]
    points = given.keypoints.copy()
    points[gaps] = np.nan
    lacking, whole = canonical([replace(given, keypoints=points), given], **COARSE).frames
    assert np.flatnonzero(np.isnan(lacking.keypoints).any(1)).tolist() == gaps
    assert (lacking.weights[:, gaps] == 0).all()
    assert_allclose(lacking.vertices, whole.vertices, atol=1e-6)


@pytest.mark.slow
def test_the_plan_says_what_ran_and_the_trace_how_it_went():
    frames = some_set()
    rows = []
    solved = canonical([frames[0], frames[1].scaled(0.1)], weights=None, on_progress=rows.append)
    assert tuple(rows) == solved.trace.rows
    assert solved.trace.stages == ("eyeglasses.weights.0", "eyeglasses.weights.1", "eyeglasses.mean")
    for stage, bar in zip(solved.trace.stages, (1e-7, 1e-7, 1e-13), strict=True):
        part = solved.trace.of_stage(stage).rows
        assert part[-1].error <= bar
        assert part[-1].evaluations >= len(part) > 0
    assert solved.plan.ran("eyeglasses.mean")
    assert solved.plan.ran("eyeglasses.units")
    assert sum(s.stage == "eyeglasses.weights" and "solved" in s.reason for s in solved.plan) == 2
    assert len(solved.plan.of_stage("eyeglasses.weights.spacing")) == 2
    given = canonical(frames[::2], mean_keypoints=solved.mean_keypoints)
    assert [s.stage for s in given.plan if s.ran] == ["eyeglasses.unbend"] * 2
    assert len(given.trace) == 0
    assert given.converged


def test_a_budget_that_ends_early_still_brings_the_key_points_together():
    glasses, given = weighted(SMALL["spread"])
    whole, short = (
        canonical([given] * 2, mean_keypoints=glasses.rest_keypoints, budget=budget, **COARSE)
        for budget in (None, Budget(evaluations=20))
    )
    assert whole.converged
    assert not short.converged
    spent = [short.trace.of_stage(stage).rows[-1].evaluations for stage in short.trace.stages]
    assert spent == [10, 10]
    assert "cut short" in short.plan[0].reason
    for frame in short.frames:
        carried = skin(given.keypoints, np.eye(20), frame.handle_transforms)
        assert_allclose(carried, frame.keypoints, atol=1e-9)
    apart = [np.abs(a.vertices - b.vertices).max() for a, b in zip(short.frames, whole.frames, strict=True)]
    assert 1e-6 < max(apart) < 5


def test_a_budget_in_seconds_ends_the_work():
    begun = time.perf_counter()
    short = canonical(some_set()[:2], weights=None, budget=1e-3)
    assert time.perf_counter() - begun < 5
    assert not short.converged
    assert all(np.isfinite(frame.vertices).all() for frame in short.frames)


@pytest.mark.slow
def test_a_frame_that_cannot_be_done_need_not_take_the_others_down():
    first, second, third = some_set()
    far, few = second.keypoints.copy(), np.full((20, 3), np.nan)
    far[3] += 500
    few[2:4] = third.keypoints[2:4]
    third = replace(third, keypoints=few)
    coarse = {"weights": None, "spacing": 3.0, "options": SKIPPING}
    result = canonical([first, replace(second, keypoints=far), third, first], **coarse)
    assert result.numbers == (0, 3)
    assert sorted(result.failures) == [1, 2]
    assert "left_rim_bridge" in result.failures[1]
    assert "2 key points" in result.failures[2]
    assert_array_equal(result.mean_keypoints, canonical([first] * 2).mean_keypoints)
    skipped = [s.reason[:8] for s in result.plan if not s.ran and s.stage == "eyeglasses.weights"]
    assert skipped == ["frame 1:", "frame 2:"]
    with pytest.raises(EyeglassesError, match="frame 0: 2 key points"):
        canonical([third], **coarse)
    with pytest.raises(EyeglassesError, match="mean_keypoints: 2 key points"):
        canonical([first], mean_keypoints=few)


GLASSES = eyeglasses(0)
TOO_FAR = np.where(np.arange(20)[:, None] == 3, GLASSES.keypoints + 500, GLASSES.keypoints)


@pytest.mark.parametrize(
    ("points", "changes", "kind", "words"),
    [
        ([], {}, EyeglassesError, "no frame"),
        ([GLASSES.keypoints] * 2, {}, ValueError, "one entry for each of 1 meshes, got 2"),
        ([GLASSES.keypoints[:19]], {}, ValueError, r"keypoints 0 is \(19, 3\), expected \(20, 3\)"),
        ([GLASSES.keypoints], {"weights": [np.ones((3, 20))]}, ValueError, r"weights 0 is \(3, 20\)"),
        ([TOO_FAR], {}, EyeglassesError, "frame 0: key point left_rim_bridge at"),
        ([GLASSES.keypoints], {"options": replace(TRANSLATED, mode="unbend")}, ValueError, 'mode="mean"'),
    ],
)
def test_bad_input_is_named(points, changes, kind, words):
    with pytest.raises(kind, match=words):
        canonicalize([GLASSES] if points else [], points, **changes)
