"""Frames brought to the mean of their key points against the truth; sets, units, budgets."""

import time
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from helpers.eyeglasses import nearest_weights, posed, volume
from helpers.measures import rms
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
COARSE = {"spacing": 3.0, "options": MEAN}
TRANSLATED = CanonicalizationOptions(mode="mean", handles="translated")


def error_and_result(glasses, weights, options=MEAN):
    """Distances of a posed frame from the unbent one, whose key points are the mean, and what is found."""
    result = canonicalize(
        [(posed(glasses.vertices, 1), glasses.faces)],
        [posed(glasses.keypoints, 1)],
        weights=[weights],
        mean_keypoints=glasses.rest_keypoints,
        options=options,
    )
    assert_allclose(result.mean_keypoints, glasses.rest_keypoints, atol=1e-9)
    (found,) = result.frames
    return np.linalg.norm(found.vertices - glasses.rest_vertices, axis=1), found


@cache
def weighted(bend, welded=True, seed=0):
    """A frame with its weights."""
    glasses = eyeglasses(seed, bend=bend, welded=welded)
    return glasses, bounded_biharmonic_weights(glasses.vertices, glasses.faces, glasses.keypoints, 3.0)


@pytest.mark.parametrize("welded", [True, False])
@pytest.mark.parametrize("name", SMALL)
def test_a_small_bend_is_undone_by_turning_key_points_better_than_by_shifts(name, welded):
    glasses, weights = weighted(SMALL[name], welded)
    error, found = error_and_result(glasses, weights)
    assert rms(error) <= 0.15
    assert error.max() <= 0.6
    before, after = (volume(v, glasses.faces) for v in (glasses.rest_vertices, found.vertices))
    assert after == pytest.approx(before, rel=0.01)
    assert np.abs(found.vertices[glasses.keypoint_vertices] - glasses.rest_keypoints).max() <= 1e-9
    shifted, frame = error_and_result(glasses, weights, TRANSLATED)
    assert rms(error) < 0.7 * rms(shifted)
    # The paper's shifts, in closed form.
    aligned, points = (
        transform_points(frame.canonical_from_frame, posed(given, 1))
        for given in (glasses.vertices, glasses.keypoints)
    )
    assert_allclose(frame.vertices, aligned + weights @ (glasses.rest_keypoints - points), atol=1e-9)


@pytest.mark.slow
def test_an_extreme_bend_stays_near():
    error, _ = error_and_result(*weighted(GlassesBend(temple_spread_mm=40, bridge_deg=10)))
    assert rms(error) < 0.7
    assert error.max() < 2.2


def test_the_way_back_is_exact():
    glasses, weights = weighted(SMALL["opened"])
    _, found = error_and_result(glasses, weights)
    given = posed(glasses.vertices, 1)
    assert_allclose(found.apply(given), found.vertices, atol=1e-12)
    assert_allclose(found.uncanonicalize(found.vertices), given, atol=1e-9)
    with pytest.raises(ValueError, match="vertices is"):
        found.uncanonicalize(given[:5])


def some_set():
    frames = [weighted(SMALL[name], seed=k) for k, name in enumerate(("spread", "twisted", "closed"))]
    meshes = [(posed(g.vertices, i), g.faces) for i, (g, _) in enumerate(frames)]
    return meshes, [posed(g.keypoints, i) for i, (g, _) in enumerate(frames)], [w for _, w in frames]


@pytest.mark.slow
def test_a_set_meets_at_its_mean_whatever_its_poses_and_order():
    meshes, points, weights = some_set()
    result = canonicalize(meshes, points, weights=weights, options=MEAN)
    assert result.converged
    assert not result.plan.ran("eyeglasses.units")
    for frame, p in zip(result.frames, points, strict=True):
        carried = skin(p, np.eye(20), frame.handle_transforms)
        assert_allclose(carried, result.mean_keypoints, atol=1e-9)
        assert 0.5 < frame.residual < 15
    back = canonicalize(
        [(posed(v, 9), f) for v, f in meshes[::-1]],
        [posed(p, 9) for p in points[::-1]],
        weights=weights[::-1],
        options=MEAN,
    )
    assert_allclose(back.mean_keypoints, result.mean_keypoints, atol=1e-8)
    assert_allclose(back.frames[2].vertices, result.frames[0].vertices, atol=1e-8)
    at = dict(zip(KEY_POINT_NAMES, result.mean_keypoints, strict=True))
    assert at["left_hinge"][0] > 50 > -50 > at["right_hinge"][0]
    assert at["left_hinge"][2] > at["left_temple_tip"][2] + 100
    assert at["bridge_top"][1] > at["bridge_bottom"][1]


def test_plan_and_result_name_widths_of_the_meshes_and_single_bridges():
    frames = [eyeglasses(0), eyeglasses(1, double_bridge=True)]
    weights = [nearest_weights(frame.vertices, frame.keypoints) for frame in frames]
    points = [frame.keypoints for frame in frames]
    mixed = canonicalize(frames, points, weights=weights, options=MEAN)
    (row,) = mixed.plan.of_stage("eyeglasses.bridges")
    assert row.level == "doubt"
    assert row.reason.startswith("frame 0: one bridge, while other frames")
    wide = [f"{front_width(frame.keypoints, frame.vertices):.4g}" for frame in frames]
    assert mixed.plan.of_stage("eyeglasses.units")[0].evidence == f"fronts {', '.join(wide)} wide"
    own = canonicalize(frames, points, weights=weights)
    assert not len(own.plan.of_stage("eyeglasses.bridges"))
    alone = canonicalize(frames[:1], points[:1], weights=weights[:1], options=MEAN)
    assert not len(alone.plan.of_stage("eyeglasses.bridges"))
    assert alone.plan.of_stage("eyeglasses.mean")[0].reason == "mean of 1 frame"


def test_the_mean_of_one_shape_in_many_poses_is_that_shape():
    glasses, weights = weighted(GlassesBend())
    meshes = [(posed(glasses.vertices, i), glasses.faces) for i in range(3)]
    result = canonicalize(meshes, [posed(glasses.keypoints, i) for i in range(3)], weights=[weights] * 3)
    same = transform_points(procrustes(glasses.keypoints, result.mean_keypoints), glasses.keypoints)
    assert_allclose(result.mean_keypoints, same, atol=1e-9)
    assert_allclose(result.mean_keypoints[list(MIRROR)], result.mean_keypoints * [-1, 1, 1], atol=1e-9)
    for frame in result.frames:
        assert frame.residual < 1e-9
        assert_allclose(frame.vertices, result.frames[0].vertices, atol=1e-9)


def test_other_units_are_brought_to_one():
    meshes, points, weights = some_set()

    def scaled(*factors):
        some = [(s * v, f) for s, (v, f) in zip(factors, meshes, strict=True)]
        return canonicalize(some, [s * p for s, p in zip(factors, points, strict=True)], weights=weights)

    plain, mixed, in_metres = scaled(1, 1, 1), scaled(1, 1e-3, 1e3), scaled(1e-3, 1e-3, 1e-3)
    assert mixed.plan.ran("eyeglasses.units")
    assert_allclose([f.scale for f in mixed.frames], [1, 1e3, 1e-3])
    for a, b in zip(mixed.frames, plain.frames, strict=True):
        assert_allclose(a.vertices, b.vertices, atol=1e-8)
    assert_allclose(mixed.frames[1].uncanonicalize(mixed.frames[1].vertices), 1e-3 * meshes[1][0], atol=1e-11)
    assert not in_metres.plan.ran("eyeglasses.units")
    assert_allclose(1e3 * in_metres.mean_keypoints, plain.mean_keypoints, atol=1e-8)


def test_a_frame_of_no_width_of_spectacles_is_refused():
    meshes, points, weights = some_set()
    meshes[1], points[1] = (meshes[1][0] / 73, meshes[1][1]), points[1] / 73
    with pytest.raises(EyeglassesError, match=r"frame 1: its front is [\d.]+ units wide.*110 to 170 mm"):
        canonicalize(meshes, points, weights=weights)
    skipping = CanonicalizationOptions(skip_failed=True)
    rest = canonicalize(meshes, points, weights=weights, options=skipping)
    assert rest.numbers == (0, 2)
    assert "units wide" in rest.failures[1]
    alone = canonicalize(meshes[::2], points[::2], weights=weights[::2])
    assert_array_equal(rest.mean_keypoints, alone.mean_keypoints)
    # A child's frame, which the caller vouches for.
    small = [(0.72 * meshes[0][0], meshes[0][1])], [0.72 * points[0]]
    admitted = CanonicalizationOptions(widths_mm=(90.0, 170.0))
    child = canonicalize(*small, weights=weights[:1], options=admitted)
    assert child.frames[0].scale == 1.0
    with pytest.raises(EyeglassesError, match="mean_keypoints: its front"):
        canonicalize(meshes[:1], points[:1], weights=weights[:1], mean_keypoints=points[1])


def test_outliers_of_a_set_are_named():
    meshes, points, weights = (2 * part for part in some_set())
    assert canonicalize(meshes, points, weights=weights).outliers == {}
    meshes[4] = (0.8 * meshes[4][0], meshes[4][1])
    points[4] = 0.8 * points[4]
    found = canonicalize(meshes, points, weights=weights)
    assert sorted(found.outliers) == [4]
    assert "wide, the median of the set is" in found.outliers[4]
    (step,) = found.plan.of_stage("eyeglasses.outliers")
    assert step.level == "doubt"
    assert step.reason.startswith("frame 4 is unlike the others: its front is")


def test_missing_key_points_are_done_without():
    glasses = eyeglasses(0, bend=SMALL["spread"])
    points = glasses.keypoints
    points[[1, 5, 12]] = np.nan
    lacking, whole = canonicalize([glasses] * 2, [points, glasses.keypoints], **COARSE).frames
    assert np.flatnonzero(np.isnan(lacking.keypoints).any(1)).tolist() == [1, 5, 12]
    assert (lacking.weights[:, [1, 5, 12]] == 0).all()
    assert_allclose(lacking.vertices, whole.vertices, atol=1e-6)


@pytest.mark.slow
def test_the_plan_says_what_ran_and_the_trace_how_it_went():
    meshes, points, weights = some_set()
    rows = []
    meshes[1], points[1] = (meshes[1][0] / 10, meshes[1][1]), points[1] / 10
    solved = canonicalize(meshes[:2], points[:2], on_progress=rows.append)
    assert tuple(rows) == solved.trace.rows
    assert solved.trace.stages == ("eyeglasses.weights.0", "eyeglasses.weights.1", "eyeglasses.mean")
    for stage, bar in (("weights.0", 1e-7), ("weights.1", 1e-7), ("mean", 1e-13)):
        part = solved.trace.of_stage(f"eyeglasses.{stage}").rows
        assert part[-1].error <= bar
        assert part[-1].evaluations >= len(part) > 0
    assert solved.plan.ran("eyeglasses.mean")
    assert solved.plan.ran("eyeglasses.units")
    assert sum(s.stage == "eyeglasses.weights" and "solved" in s.reason for s in solved.plan) == 2
    assert len(solved.plan.of_stage("eyeglasses.weights.spacing")) == 2
    given = canonicalize(meshes[::2], points[::2], weights=weights[::2], mean_keypoints=solved.mean_keypoints)
    assert [s.stage for s in given.plan if s.ran] == ["eyeglasses.unbend"] * 2
    assert len(given.trace) == 0
    assert given.converged


def test_a_budget_that_ends_early_still_brings_the_key_points_together():
    glasses, _ = weighted(SMALL["spread"])
    marks = [glasses.keypoints] * 2
    given = {"meshes": [glasses] * 2, "keypoints": marks, "mean_keypoints": glasses.rest_keypoints, **COARSE}
    whole, short = canonicalize(**given), canonicalize(**given, budget=Budget(evaluations=20))
    assert whole.converged
    assert not short.converged
    spent = [short.trace.of_stage(stage).rows[-1].evaluations for stage in short.trace.stages]
    assert spent == [10, 10]
    assert "cut short" in short.plan[0].reason
    for frame, p in zip(short.frames, marks, strict=True):
        assert_allclose(skin(p, np.eye(20), frame.handle_transforms), frame.keypoints, atol=1e-9)
    apart = [np.abs(a.vertices - b.vertices).max() for a, b in zip(short.frames, whole.frames, strict=True)]
    assert 1e-6 < max(apart) < 5


def test_a_budget_in_seconds_ends_the_work():
    meshes, points, _ = some_set()
    begun = time.perf_counter()
    short = canonicalize(meshes[:2], points[:2], budget=1e-3)
    assert time.perf_counter() - begun < 5
    assert not short.converged
    assert all(np.isfinite(frame.vertices).all() for frame in short.frames)


@pytest.mark.slow
def test_a_frame_that_cannot_be_done_need_not_take_the_others_down():
    meshes, points, weights = some_set()
    far, few = points[1].copy(), np.full((20, 3), np.nan)
    far[3] += 500
    few[2:4] = points[2][2:4]
    given = [*meshes, meshes[0]], [points[0], far, few, points[0]]
    skipping = CanonicalizationOptions(skip_failed=True)
    result = canonicalize(*given, spacing=3.0, options=skipping)
    assert result.numbers == (0, 3)
    assert sorted(result.failures) == [1, 2]
    assert "left_rim_bridge" in result.failures[1]
    assert "2 key points" in result.failures[2]
    alone = canonicalize(meshes[:1] * 2, points[:1] * 2, **COARSE)
    assert_array_equal(result.mean_keypoints, alone.mean_keypoints)
    skipped = [s.reason[:8] for s in result.plan if not s.ran and s.stage == "eyeglasses.weights"]
    assert skipped == ["frame 1:", "frame 2:"]
    with pytest.raises(EyeglassesError, match="frame 1: key point left_rim_bridge"):
        canonicalize(*given, **COARSE)
    with pytest.raises(EyeglassesError, match="frame 0: 2 key points"):
        canonicalize([meshes[2]], [few], spacing=3.0, options=skipping)
    with pytest.raises(EyeglassesError, match="mean_keypoints: 2 key points"):
        canonicalize(meshes[:1], points[:1], weights=weights[:1], mean_keypoints=few)


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
