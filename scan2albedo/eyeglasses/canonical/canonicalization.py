"""Frames without pose and bend: each in its own shape, or with all key points on the mean's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core import Budget, Meter, Plan, PlanStep, ProgressCallback, Trace
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.canonical.frame_weights import WeightedFrame, frames_of, weigh_frames
from scan2albedo.eyeglasses.canonical.mean_keypoints import (
    MeanKeyPoints,
    align_key_points,
    in_own_axes,
    mean_key_points,
    require_posable,
)
from scan2albedo.eyeglasses.canonical.sizes import (
    WIDTHS_MM,
    outliers,
    single_bridges,
    unit_exponent,
    unit_factors,
)
from scan2albedo.eyeglasses.canonical.unbending import (
    FrontHalves,
    front_halves,
    symmetric_key_points,
    unbent_transforms,
)
from scan2albedo.eyeglasses.checks import checked_keypoints
from scan2albedo.eyeglasses.skinning import skin, translations, turned_translations
from scan2albedo.eyeglasses.weighting.embedding import WeightOptions
from scan2albedo.geometry.rigid import transform_points

CanonicalMode = Literal["unbend", "mean"]
_CARRIERS = {"turned": turned_translations, "translated": translations}


@dataclass(frozen=True)
class CanonicalizationOptions:
    """Settings of `canonicalize`."""

    mode: CanonicalMode = "unbend"
    """"unbend": pose and bend go, the frame's own shape and sizes stay. "mean" (the paper's S2): all key
    points go to the mean's, which gives every frame the proportions of the mean."""
    handles: Literal["turned", "translated"] = "turned"
    """In "mean": whether key points turn their surroundings as the skeleton turns, or only shift them (the
    paper's)."""
    spacing: str | float = "auto"
    """Of the weights' lattice, in the meshes' unit."""
    weights: WeightOptions = WeightOptions()
    """How weights are solved, where none are given."""
    widths_mm: tuple[float, float] = WIDTHS_MM
    """Least and greatest width of a front; a frame that no decimal unit brings between them is refused."""
    skip_failed: bool = False
    """Whether a frame that cannot be done is left out and named in the result, instead of ending the call."""


@dataclass(frozen=True)
class CanonicalEyeglasses:
    """A frame in canonical pose and shape, and the way there and back; see `canonicalize`."""

    vertices: FloatArray
    """(V, 3)."""
    faces: IntArray
    """(F, 3)."""
    weights: FloatArray
    """(V, 20); zero columns for key points that the frame lacks."""
    keypoints: FloatArray
    """(20, 3) canonical, NaN where the frame lacks them: its own, unbent, or in mode "mean" the mean's."""
    canonical_from_frame: FloatArray
    """(4, 4) rigid, after `scale`."""
    scale: float
    """Factor on the frame's coordinates before anything else; 1 unless units differ."""
    handle_transforms: FloatArray
    """(20, 4, 4) from the frame as given to canonical space, scale and rigid part included."""
    residual: float
    """Root mean square distance of the key points from `keypoints` after the rigid part: how bent it was,
    and in mode "mean" also how unlike the mean."""
    unbent: bool
    """Whether it keeps its own shape and sizes (mode "unbend"); False: its key points are the mean's."""
    converged: bool
    """Whether its weights converged, or were given."""
    plan: Plan
    """How its weights were found and its bend taken away."""

    def apply(self, vertices: ArrayLike) -> FloatArray:
        """Return the frame's vertices (V, 3), as given or edited, in canonical space."""
        return skin(vertices, self.weights, self.handle_transforms)

    def uncanonicalize(self, vertices: ArrayLike) -> FloatArray:
        """Return canonical vertices (V, 3), edited or not, back in the frame's pose, bend and unit.

        The exact inverse of `apply`: each vertex's own blended affine map, inverted. Raises ValueError when
        there are not as many vertices as weights.
        """
        xyz = np.asarray(vertices, np.float64)
        if xyz.shape != (len(self.weights), 3):
            raise ValueError(f"vertices must have shape ({len(self.weights)}, 3), got {xyz.shape}")
        blended = (self.weights @ self.handle_transforms[:, :3].reshape(-1, 12)).reshape(-1, 3, 4)
        back = np.linalg.solve(blended[:, :, :3], (xyz - blended[:, :, 3])[:, :, None])
        return np.asarray(back[:, :, 0])


@dataclass(frozen=True)
class CanonicalSet:
    """Frames on common ground."""

    frames: tuple[CanonicalEyeglasses, ...]
    """In the order of the meshes given."""
    mean_keypoints: FloatArray
    """(20, 3) in the frames' unit; unless given, x to the wearer's left, z to the front, centroid at 0."""
    converged: bool
    """Whether the mean's iteration settled and the weights that were solved converged."""
    iterations: int
    """Of the mean; 0 when it was given."""
    units_differed: bool
    """Whether frames were scaled to one unit."""
    numbers: tuple[int, ...]
    """Of each of the `frames` among the meshes given: all, unless some failed."""
    failures: Mapping[int, str]
    """Why, for each mesh that was left out; empty unless `CanonicalizationOptions.skip_failed`."""
    outliers: Mapping[int, str]
    """What is unusual about a mesh of the set, by its number: its width or its key points, in sets of four or
    more. Outliers are canonicalised like the others and count in the mean."""
    single_bridges: tuple[int, ...]
    """In mode "mean", numbers of the meshes with one bridge where others, or a given mean, have two: the
    mean's `bridge_top` lies between the two kinds, and draws a single bridge out into a spike."""
    plan: Plan
    """What ran and what was left out; the steps of a frame say its number."""
    trace: Trace
    """Weights of each frame, then the mean."""


def canonicalize(
    meshes: Sequence[Any],
    keypoints: Sequence[ArrayLike],
    *,
    weights: Sequence[ArrayLike] | None = None,
    mean_keypoints: ArrayLike | None = None,
    budget: Budget | float | None = None,
    options: CanonicalizationOptions = CanonicalizationOptions(),
    on_progress: ProgressCallback | None = None,
) -> CanonicalSet:
    """Return frames without pose and bend, in their own shape or in the proportions of their mean.

    Each frame is aligned rigidly to the mean key points, then its key points p are moved to targets x and the
    surface follows by its bounded biharmonic weights w,

        v' = sum over k of w_k (R_k (v - p_k) + x_k).

    Mode "unbend": the targets are the frame's own. Its halves are laid on each other and each moved half the
    way, so that rims, bridge and temples move rigidly and come to mirror each other; shapes and sizes stay.
    What both sides are bent to alike cannot be told from the frame and stays too. Mode "mean" (equation S2):
    the targets are the mean's key points and R_k the skeleton's turn at each, or 1 for v' = v + W (x - p).
    Every bend goes, and rims and temples take the mean's widths, heights and lengths.

    Parameters
    ----------
    meshes : sequence of n
        Pairs (vertices (V, 3), faces (F, 3)), or objects with these attributes, such as `RawScan`; any unit.
    keypoints : sequence of n (20, 3) array_like
        In the mesh's unit and the order of `KEY_POINT_NAMES`; NaN for missing ones.
    weights : sequence of n (V, 20) array_like, optional
        From an earlier run; solved here otherwise, which takes nearly all the time.
    mean_keypoints : (20, 3) array_like, optional
        Of an earlier set, for this one's: where frames are placed and, in mode "mean", what they are
        brought to.
    budget : Budget or float, optional
        Seconds, or evaluations: Newton steps of the weights and rounds of the mean. Frames share it evenly;
        when it ends, weights and mean so far are used, with `converged` False. Key points meet all the same.
    options : CanonicalizationOptions
    on_progress : callable, optional
        Called with each row of the trace.

    Raises
    ------
    EyeglassesError
        When there is no frame, key points do not fix a pose, a frame has no width of spectacles, or weights
        cannot be solved; names the frame.
    ValueError
        When shapes do not fit together.

    Notes
    -----
    Equation S2 of Li et al., read literally, collapses the frame; the case R_k = 1 is what it must mean.
    Shifts alone flatten a bend between key points, where turning ones halve the error; a similarity instead
    of a rigid transform would change the tube's thickness.

    Frames are 110 to 170 mm wide, so that the width tells a frame's unit. Frames of different units are
    brought to the unit of the mean that is given, or to mm, by powers of ten: see
    `CanonicalEyeglasses.scale`.

    Examples
    --------
    >>> from scan2albedo.synthetic import GlassesBend, eyeglasses
    >>> bent = eyeglasses(bend=GlassesBend(temple_spread_mm=8.0))
    >>> options = CanonicalizationOptions(mode="mean", spacing=2.5)
    >>> found = canonicalize([bent], [bent.keypoints], mean_keypoints=bent.rest_keypoints, options=options)
    >>> bool(np.abs(found.frames[0].vertices - bent.rest_vertices).max() < 0.6)
    True
    """
    if options.mode == "unbend" and options.handles != "turned":
        raise ValueError('handles="translated" is for mode="mean": shifts alone would bend the rims')
    meter = Meter("eyeglasses.canonicalize", "", Budget.of(budget), on_progress)
    frames = frames_of(meshes, keypoints, weights)
    reference = None if mean_keypoints is None else _reference(mean_keypoints)
    common = None if reference is None else _unit_of_mean(reference, options)
    weighted, failures = weigh_frames(
        frames,
        reference,
        spacing=options.spacing,
        widths_mm=options.widths_mm,
        options=options.weights,
        skip_failed=options.skip_failed,
        meter=meter,
    )
    scales = unit_factors([w.unit_exponent for w in weighted], common)
    points = [scale * w.frame.points for scale, w in zip(scales, weighted, strict=True)]
    widths = scales * [w.width for w in weighted]
    unusual = {weighted[i].frame.number: reason for i, reason in outliers(points, widths).items()}
    one_bridge = single_bridges(points, widths, reference) if options.mode == "mean" else ()
    single = tuple(weighted[i].frame.number for i in one_bridge)
    mean = _mean(points, reference, meter)
    done = _canonical_frames(weighted, scales, mean.points, reference is not None, options)
    return CanonicalSet(
        frames=done,
        mean_keypoints=mean.points,
        converged=mean.converged and all(frame.converged for frame in done),
        iterations=mean.iterations,
        units_differed=bool((scales != 1).any()),
        numbers=tuple(w.frame.number for w in weighted),
        failures=failures,
        outliers=unusual,
        single_bridges=single,
        plan=_plan(weighted, done, failures)
        + Plan(
            (
                _unit_step(widths, scales),
                _outlier_step(unusual, len(done)),
                *_bridge_steps(single),
                _mean_step(mean, reference is not None, len(done)),
            )
        ),
        trace=meter.trace,
    )


def _reference(mean_keypoints: ArrayLike) -> FloatArray:
    points = checked_keypoints("mean_keypoints", mean_keypoints)
    require_posable(points, "mean_keypoints")
    return points


def _mean(points: list[FloatArray], reference: FloatArray | None, meter: Meter) -> MeanKeyPoints:
    if reference is not None:
        return MeanKeyPoints(reference, True, 0)
    own = meter.sub_meter("eyeglasses.mean", "bones")
    found = mean_key_points(points, own)
    meter.merge(own)
    return found


def _unit_of_mean(reference: FloatArray, options: CanonicalizationOptions) -> int:
    try:
        return unit_exponent(reference, options.widths_mm)
    except EyeglassesError as error:
        raise EyeglassesError(f"mean_keypoints: {error}") from error


def _plan(
    weighted: list[WeightedFrame], done: tuple[CanonicalEyeglasses, ...], failures: Mapping[int, str]
) -> Plan:
    steps = {w.frame.number: frame.plan for w, frame in zip(weighted, done, strict=True)}
    steps |= {i: Plan((PlanStep("eyeglasses.weights", False, why),)) for i, why in failures.items()}
    return Plan(
        tuple(replace(s, reason=f"frame {i}: {s.reason}") for i, part in sorted(steps.items()) for s in part)
    )


def _unit_step(widths: FloatArray, scales: FloatArray) -> PlanStep:
    wide = "fronts " + ", ".join(f"{width:.4g}" for width in widths) + " wide"
    if (scales == 1).all():
        return PlanStep("eyeglasses.units", False, "widths agree: one unit", wide)
    factors = ", ".join(f"{s:.6g}" for s in scales)
    reason = "widths are those of different units"
    return PlanStep("eyeglasses.units", True, reason, f"factors {factors}; then {wide}")


def _outlier_step(unusual: Mapping[int, str], count: int) -> PlanStep:
    if not unusual:
        return PlanStep("eyeglasses.outliers", False, f"none among {_counted(count, 'frame')}")
    reason = "; ".join(f"frame {i}: {why}" for i, why in unusual.items())
    return PlanStep("eyeglasses.outliers", True, reason, f"{len(unusual)} of {_counted(count, 'frame')}")


def _bridge_steps(single: tuple[int, ...]) -> tuple[PlanStep, ...]:
    if not single:
        return ()
    which = f"frame{'s' * (len(single) > 1)} {', '.join(map(str, single))}"
    reason = f"one bridge on {which}, two on others: the mean's bridge_top belongs to neither"
    return (PlanStep("eyeglasses.bridges", False, reason),)


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


def _mean_step(mean: MeanKeyPoints, given: bool, count: int) -> PlanStep:
    if given:
        return PlanStep("eyeglasses.mean", False, "given")
    how = "settled" if mean.converged else "not settled"
    rounds = _counted(mean.iterations, "round")
    return PlanStep("eyeglasses.mean", True, f"mean of {_counted(count, 'frame')}", f"{how} after {rounds}")


def _canonical_frames(
    weighted: list[WeightedFrame],
    scales: FloatArray,
    mean: FloatArray,
    given: bool,
    options: CanonicalizationOptions,
) -> tuple[CanonicalEyeglasses, ...]:
    if options.mode == "mean":
        return tuple(
            _brought_to_mean(w, mean, float(scale), options)
            for w, scale in zip(weighted, scales, strict=True)
        )
    symmetric = symmetric_key_points(mean)
    place = symmetric if given else in_own_axes(symmetric)
    return tuple(_unbent(w, place, float(scale)) for w, scale in zip(weighted, scales, strict=True))


def _brought_to_mean(
    weighted: WeightedFrame, mean: FloatArray, scale: float, options: CanonicalizationOptions
) -> CanonicalEyeglasses:
    points = scale * weighted.frame.points
    rigid = align_key_points(points, mean)
    aligned = transform_points(rigid, points)
    seen = np.isfinite((aligned + mean).sum(1))
    carriers = _CARRIERS[options.handles](aligned, mean)
    # Key points that the frame lacks weigh nothing; NaN times nothing would still be NaN.
    carriers[~seen] = np.eye(4)
    targets = np.where(seen[:, None], mean, np.nan)
    step = PlanStep("eyeglasses.to_mean", True, "all key points on the mean's")
    return _moved(weighted, carriers @ rigid, targets, scale, step)


def _unbent(weighted: WeightedFrame, place: FloatArray, scale: float) -> CanonicalEyeglasses:
    """Return a frame without its bend, with its plane of symmetry that of the key points `place` (20, 3)."""
    frame, points = weighted.frame, scale * weighted.frame.points
    halves = front_halves(scale * frame.vertices, frame.faces, weighted.weights, points)
    own = unbent_transforms(points, halves)
    straight = np.einsum("kij,kj->ki", own[:, :3, :3], points) + own[:, :3, 3]
    pose = align_key_points(straight if halves is None else halves.symmetric(straight), place)
    return _moved(weighted, pose @ own, transform_points(pose, straight), scale, _unbend_step(halves))


def _unbend_step(halves: FrontHalves | None) -> PlanStep:
    if halves is None:
        reason = "too few key points are known on both sides to compare them: only the pose is taken away"
        return PlanStep("eyeglasses.unbend", False, reason)
    turn = f"halves turned against each other by {halves.bend_deg:.2f} degrees"
    if np.isnan(halves.apart):
        return PlanStep("eyeglasses.unbend", True, "own shape kept, halves compared by key points", turn)
    reason = "own shape kept, halves compared by their surfaces"
    return PlanStep("eyeglasses.unbend", True, reason, f"{turn}; rims then {halves.apart:.3g} apart, rms")


def _moved(
    weighted: WeightedFrame, carriers: FloatArray, targets: FloatArray, scale: float, step: PlanStep
) -> CanonicalEyeglasses:
    """Return a frame moved by carriers (20, 4, 4) of its scaled key points to their `targets` (20, 3)."""
    frame, points = weighted.frame, scale * weighted.frame.points
    rigid = align_key_points(points, targets)
    transforms = carriers @ np.diag([scale, scale, scale, 1.0])
    off = transform_points(rigid, points) - targets
    return CanonicalEyeglasses(
        vertices=skin(frame.vertices, weighted.weights, transforms),
        faces=frame.faces,
        weights=weighted.weights,
        keypoints=targets,
        canonical_from_frame=rigid,
        scale=scale,
        handle_transforms=transforms,
        residual=float(np.sqrt((off[np.isfinite(off).all(1)] ** 2).sum(1).mean())),
        unbent=step.stage == "eyeglasses.unbend",
        converged=weighted.converged,
        plan=weighted.plan + Plan((step,)),
    )
