"""Frames brought to the mean of their key points, without their bends."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core import Budget, Meter, Plan, PlanStep, ProgressCallback, Trace
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.eyeglasses.canonical.frame_weights import WeightedFrame, frames_of, weigh_frames
from scan2albedo.eyeglasses.canonical.mean_keypoints import (
    MeanKeyPoints,
    align_key_points,
    key_point_size,
    mean_key_points,
    require_posable,
    unit_factors,
)
from scan2albedo.eyeglasses.checks import checked_keypoints
from scan2albedo.eyeglasses.skinning import skin, translations, turned_translations
from scan2albedo.eyeglasses.weighting.embedding import WeightOptions
from scan2albedo.geometry.rigid import transform_points

_CARRIERS = {"turned": turned_translations, "translated": translations}


@dataclass(frozen=True)
class CanonicalizationOptions:
    """Settings of `canonicalize`."""

    handles: Literal["turned", "translated"] = "turned"
    """Whether key points turn their surroundings as the skeleton turns, or only shift them (the paper's)."""
    spacing: str | float = "auto"
    """Of the weights' lattice, in the meshes' unit."""
    weights: WeightOptions = WeightOptions()
    """How weights are solved, where none are given."""
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
    """(20, 3) canonical, NaN where the frame lacks them."""
    canonical_from_frame: FloatArray
    """(4, 4) rigid, after `scale`."""
    scale: float
    """Factor on the frame's coordinates before anything else; 1 unless units differ."""
    handle_transforms: FloatArray
    """(20, 4, 4) from the frame as given to canonical space, scale and rigid part included."""
    residual: float
    """Root mean square distance of the key points from the mean after the rigid part: how bent it was."""
    converged: bool
    """Whether its weights converged, or were given."""
    plan: Plan
    """How its weights were found."""

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
    """Return frames brought to the mean of their key points: poses and bends go, shapes and thicknesses stay.

    Each frame is aligned rigidly to the mean key points x, then its key points p are moved onto them and the
    surface follows by its bounded biharmonic weights w,

        v' = sum over k of w_k (R_k (v - p_k) + x_k),

    with R_k the skeleton's turn at each key point, or R_k = 1 for v' = v + W (x - p).

    Parameters
    ----------
    meshes : sequence of n
        Pairs (vertices (V, 3), faces (F, 3)), or objects with these attributes, such as `RawScan`; any unit.
    keypoints : sequence of n (20, 3) array_like
        In the mesh's unit and the order of `KEY_POINT_NAMES`; NaN for missing ones.
    weights : sequence of n (V, 20) array_like, optional
        From an earlier run; solved here otherwise, which takes nearly all the time.
    mean_keypoints : (20, 3) array_like, optional
        To bring further frames to an earlier set's mean.
    budget : Budget or float, optional
        Seconds, or evaluations: Newton steps of the weights and rounds of the mean. Frames share it evenly;
        when it ends, weights and mean so far are used, with `converged` False. Key points meet all the same.
    options : CanonicalizationOptions
    on_progress : callable, optional
        Called with each row of the trace.

    Raises
    ------
    EyeglassesError
        When there is no frame, key points do not fix a pose, or weights cannot be solved; names the frame.
    ValueError
        When shapes do not fit together.

    Notes
    -----
    Equation S2 of Li et al., read literally, collapses the frame; the case R_k = 1 is what it must mean.
    Shifts alone flatten a bend between key points, where turning ones halve the error; a similarity instead
    of a rigid transform would change the tube's thickness.

    Frames whose sizes differ more than five times are brought to one unit, see `CanonicalEyeglasses.scale`.

    Examples
    --------
    >>> from scan2albedo.synthetic import GlassesBend, eyeglasses
    >>> bent = eyeglasses(bend=GlassesBend(temple_spread_mm=8.0))
    >>> options = CanonicalizationOptions(spacing=2.5)
    >>> found = canonicalize([bent], [bent.keypoints], mean_keypoints=bent.rest_keypoints, options=options)
    >>> bool(np.abs(found.frames[0].vertices - bent.rest_vertices).max() < 0.6)
    True
    """
    meter = Meter("eyeglasses.canonicalize", "", Budget.of(budget), on_progress)
    frames = frames_of(meshes, keypoints, weights)
    reference = None if mean_keypoints is None else _reference(mean_keypoints)
    weighted, failures = weigh_frames(
        frames,
        reference,
        spacing=options.spacing,
        options=options.weights,
        skip_failed=options.skip_failed,
        meter=meter,
    )
    points = [w.frame.points for w in weighted]
    scales = unit_factors(points, reference)
    mean = _mean([scale * p for scale, p in zip(scales, points, strict=True)], reference, meter)
    done = tuple(
        _canonical(w, mean.points, float(scale), options) for w, scale in zip(weighted, scales, strict=True)
    )
    return CanonicalSet(
        frames=done,
        mean_keypoints=mean.points,
        converged=mean.converged and all(frame.converged for frame in done),
        iterations=mean.iterations,
        units_differed=bool((scales != 1).any()),
        numbers=tuple(w.frame.number for w in weighted),
        failures=failures,
        plan=_plan(weighted, failures, scales, mean, reference is not None),
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


def _plan(
    weighted: list[WeightedFrame],
    failures: Mapping[int, str],
    scales: FloatArray,
    mean: MeanKeyPoints,
    given: bool,
) -> Plan:
    steps = {w.frame.number: w.plan for w in weighted}
    steps |= {i: Plan((PlanStep("eyeglasses.weights", False, why),)) for i, why in failures.items()}
    plan = Plan(
        tuple(replace(s, reason=f"frame {i}: {s.reason}") for i, part in sorted(steps.items()) for s in part)
    )
    return plan + Plan((_unit_step(weighted, scales), _mean_step(mean, given, len(weighted))))


def _unit_step(weighted: list[WeightedFrame], scales: FloatArray) -> PlanStep:
    sizes = [key_point_size(w.frame.points) for w in weighted]
    if (scales == 1).all():
        evidence = f"largest over smallest: {max(sizes) / min(sizes):.3g}"
        return PlanStep("eyeglasses.units", False, "sizes agree: one unit", evidence)
    factors = ", ".join(f"{s:.6g}" for s in scales)
    return PlanStep("eyeglasses.units", True, "sizes are those of different units", f"factors {factors}")


def _mean_step(mean: MeanKeyPoints, given: bool, count: int) -> PlanStep:
    if given:
        return PlanStep("eyeglasses.mean", False, "given")
    how = "settled" if mean.converged else "not settled"
    return PlanStep(
        "eyeglasses.mean", True, f"mean of {count} frames", f"{how} after {mean.iterations} rounds"
    )


def _canonical(
    weighted: WeightedFrame, mean: FloatArray, scale: float, options: CanonicalizationOptions
) -> CanonicalEyeglasses:
    frame, weights = weighted.frame, weighted.weights
    rigid = align_key_points(scale * frame.points, mean)
    aligned = transform_points(rigid, scale * frame.points)
    seen = np.isfinite((aligned + mean).sum(1))
    carriers = _CARRIERS[options.handles](aligned, mean)
    # Key points that the frame lacks weigh nothing; NaN times nothing would still be NaN.
    carriers[~seen] = np.eye(4)
    transforms = carriers @ rigid @ np.diag([scale, scale, scale, 1.0])
    return CanonicalEyeglasses(
        vertices=skin(frame.vertices, weights, transforms),
        faces=frame.faces,
        weights=weights,
        keypoints=np.where(seen[:, None], mean, np.nan),
        canonical_from_frame=rigid,
        scale=scale,
        handle_transforms=transforms,
        residual=float(np.sqrt(((aligned - mean)[seen] ** 2).sum(1).mean())),
        converged=weighted.converged,
        plan=weighted.plan,
    )
