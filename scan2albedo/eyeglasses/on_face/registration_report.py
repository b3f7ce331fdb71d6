"""From the state a registration ended in to its result, in the caller's unit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from scan2albedo.core import Meter, Plan, PlanStep
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES
from scan2albedo.eyeglasses.on_face.frame_motion import FrameMotion, FrameState, SkinnedPoints
from scan2albedo.eyeglasses.on_face.interface import (
    OBSERVED_MM,
    FaceRegistrationOptions,
    RegisteredEyeglasses,
)
from scan2albedo.eyeglasses.on_face.objective import (
    FrameEstimate,
    Linearization,
    ObservedView,
    OutlineSamples,
    RegistrationObjective,
)
from scan2albedo.eyeglasses.on_face.observability import (
    Noise,
    PointDeviations,
    compare_masks,
    contradicted,
    deviation_along,
    expected_distance,
    measured_noise,
    worst_deviation,
)
from scan2albedo.eyeglasses.on_face.outline_samples import OutlineSampler, hidden_by
from scan2albedo.eyeglasses.on_face.registration_inputs import RegistrationInputs
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.pinhole import camera_centers, project

_MODEL_MM, _MODEL_BENT = 0.06, 0.21
"""What key points and weights cannot follow: at rest, and where they shift by 1 mm; it grows as the root."""
_ONE_VIEW, _ONE_VIEW_RESTED = 2.0, 1.4
"""Errors over stated deviations, measured on 26 wearers seen from one place, free and resting on the nose."""
_APART = 0.02
"""Distance of cameras, as a part of that to the frame, from which they count as two places."""
_MISFIT = 1 / 3
"""Share of labels that may be outliers: with more, which are the right ones is a guess."""
_ANYWHERE_MM = 1e6
"""Deviation of a point that nothing determines: finite, so that products with weights of 0 stay 0."""
_LEAST_NOISE_PX = 0.3
"""Below it pixels and the bend's model limit the accuracy, not labels."""


def report(
    given: RegistrationInputs,
    sampler: OutlineSampler,
    objective: RegistrationObjective,
    found: FrameEstimate,
    *,
    bend_found: bool,
    meter: Meter,
    plan: Plan,
) -> RegisteredEyeglasses:
    """Return the result of a registration that ended in `found`."""
    options, state = objective.options, found.state
    motion = objective.motion(state)
    # Behind the frame's own points there may be those of lenses that only masks show.
    own = slice(len(given.vertices))
    points = SkinnedPoints(sampler.mesh.points.rest[own], sampler.mesh.points.weights[own])
    marks = _marks(given)
    vertices, keypoints = motion.positions(points), motion.positions(marks)
    samples = sampler.sample(motion, mark_deviations(given, motion, found.at))
    at = objective.linearize(state, samples, rigid=not options.bend)
    noise = measured_noise(at, _LEAST_NOISE_PX, Noise(options.label_noise_px, options.outline_noise_px))
    deviations = PointDeviations(motion, _matrix(objective, state, samples, noise))
    visible = np.stack([_visible(sampler, view, vertices) for view in given.views])
    marks_visible = np.stack([_visible(sampler, view, keypoints) for view in given.views]) & given.known
    covariances = deviations.covariances(marks)
    inflation = _inflation(given, keypoints, objective)
    deviation, mark_deviation = (
        np.hypot(inflation * expected_distance(c), _unmodelled_mm(p, state))
        for p, c in ((points, deviations.covariances(points)), (marks, covariances))
    )
    depth = inflation * _depth_deviation(given.views, keypoints, covariances, marks_visible)
    misfit = _misfit(at, options.label_noise_px)
    trusted = bend_found and misfit <= _MISFIT
    agreements = [
        compare_masks(sampler, motion, number, mask, noise.outline_px)
        for number, (view, mask) in enumerate(zip(given.views, given.masks, strict=True))
        if mask is not None and view.distance is not None
    ]
    wrong = contradicted(agreements, len(keypoints)) & given.known
    unit = given.unit
    world = motion.world_from_frame
    lost = np.where(given.known, 1.0, np.nan)
    return RegisteredEyeglasses(
        vertices=unit * vertices,
        faces=given.faces,
        weights=points.weights,
        keypoints=unit * keypoints * lost[:, None],
        world_from_glasses=_in_units(world, unit),
        handle_transforms=np.stack([_in_units(t, unit) for t in motion.transforms]),
        bend=unit * state.shifts,
        visible=visible,
        deviation=unit * deviation,
        observed=trusted & visible.any(0) & (deviation <= OBSERVED_MM) & ~wrong[points.weights.argmax(1)],
        keypoint_deviation=unit * mark_deviation * lost,
        keypoints_observed=trusted & marks_visible.any(0) & (mark_deviation <= OBSERVED_MM) & ~wrong,
        depth_deviation=unit * depth,
        depth_observed=bool(trusted and depth <= OBSERVED_MM and inflation < _ONE_VIEW),
        label_errors_px=at.labels_px,
        inliers=at.labels_px <= 3 * options.label_noise_px,
        outline_rms_px=_outline_rms(at, samples, len(given.views)),
        iou=_of_views(given, [agreement.iou for agreement in agreements]),
        converged=found.converged,
        iterations=meter.evaluations,
        plan=plan + _reported(depth, marks_visible, mark_deviation, wrong, misfit, bend_found, given),
        trace=meter.trace,
    )


def depth_open(given: RegistrationInputs, motion: FrameMotion, at: Linearization) -> float:
    """Return the standard deviation of the key points along the line of sight, mm, the head left aside."""
    if not given.labelled:
        return _ANYWHERE_MM
    covariances = PointDeviations(motion, at.matrix).covariances(_marks(given))
    seen = np.tile(given.known, (len(given.views), 1))
    return _depth_deviation(given.views, motion.positions(_marks(given)), covariances, seen)


def mark_deviations(given: RegistrationInputs, motion: FrameMotion, at: Linearization) -> FloatArray:
    """Return (20,) standard deviations of the key points, mm; far off without labels and outlines."""
    if not given.labelled and len(at.outline_px) == 0:
        return np.full(len(given.keypoints), _ANYWHERE_MM)
    return worst_deviation(PointDeviations(motion, at.matrix).covariances(_marks(given)))


def _unmodelled_mm(points: SkinnedPoints, state: FrameState) -> FloatArray:
    """Return (N,) how far points may be off because frames bend otherwise than their key points say."""
    bend_mm = points.weights @ np.linalg.norm(state.shifts, axis=1)
    return np.hypot(_MODEL_MM, _MODEL_BENT * np.sqrt(np.maximum(bend_mm, 0.0)))


def _misfit(at: Linearization, noise_px: float) -> float:
    """Return the share of labels off by more than three times their usual noise."""
    errors = at.labels_px[~np.isnan(at.labels_px)]
    return float((errors > 3 * noise_px).mean()) if len(errors) else 0.0


def _inflation(given: RegistrationInputs, keypoints: FloatArray, objective: RegistrationObjective) -> float:
    """Return the factor on deviations: pictures from one place leave more open than the matrix says."""
    used = [v for v in given.views if v.distance is not None or np.isfinite(v.labels).all(1).any()]
    if not used:
        return 1.0
    centers = camera_centers(np.stack([view.camera for view in used]))
    away = np.linalg.norm(keypoints[given.known].mean(0) - centers[0])
    if np.linalg.norm(centers - centers[0], axis=1).max() > _APART * away:
        return 1.0
    return _ONE_VIEW if objective.contact is None else _ONE_VIEW_RESTED


def _marks(given: RegistrationInputs) -> SkinnedPoints:
    return SkinnedPoints(np.nan_to_num(given.keypoints), np.eye(len(given.keypoints)))


def _matrix(
    objective: RegistrationObjective, state: FrameState, samples: OutlineSamples, noise: Noise
) -> FloatArray:
    """Return the Gauss-Newton matrix with labels and outlines weighted by the noise that they show."""
    options: FaceRegistrationOptions = replace(
        objective.options, label_noise_px=noise.label_px, outline_noise_px=noise.outline_px
    )
    weighted = RegistrationObjective(objective.keypoints, objective.views, options, objective.contact)
    return weighted.linearize(state, samples, rigid=not options.bend).matrix


def _visible(sampler: OutlineSampler, view: ObservedView, points: FloatArray) -> BoolArray:
    """Return (N,) True for points in the picture that the head does not hide."""
    pixels, depth = project(view.camera, points)
    inside = depth > 0
    if view.shape is not None:
        limit = np.array([view.shape[1], view.shape[0]]) - 0.5
        with np.errstate(invalid="ignore"):
            inside &= ((pixels >= -0.5) & (pixels <= limit)).all(1)
    return inside & ~hidden_by(sampler.head, view.camera, points)


def _depth_deviation(
    views: tuple[ObservedView, ...], keypoints: FloatArray, covariances: FloatArray, visible: BoolArray
) -> float:
    """Return the root mean square deviation along each view's rays, of the view that knows depth best."""
    best = np.inf
    for view, seen in zip(views, visible, strict=True):
        if seen.any():
            rays = normalized(keypoints[seen] - camera_centers(view.camera[None])[0])
            along = deviation_along(covariances[seen], rays)
            best = min(best, float(np.sqrt((along**2).mean())))
    return best


def _outline_rms(at: Linearization, samples: OutlineSamples, count: int) -> FloatArray:
    result = np.full(count, np.nan)
    for number in range(count):
        errors = at.outline_px[samples.view == number]
        errors = errors[np.isfinite(errors)]
        if len(errors):
            result[number] = np.sqrt((errors**2).mean())
    return result


def _of_views(given: RegistrationInputs, values: list[float]) -> FloatArray:
    """Return (C,) values of the views with a mask that counts, NaN for the others."""
    result = np.full(len(given.views), np.nan)
    result[[view.distance is not None for view in given.views]] = values
    return result


def _in_units(transform: FloatArray, unit: float) -> FloatArray:
    result = transform.copy()
    result[:3, 3] *= unit
    return result


def _reported(
    depth: float,
    visible: BoolArray,
    deviation: FloatArray,
    wrong: BoolArray,
    misfit: float,
    bend_found: bool,
    given: RegistrationInputs,
) -> Plan:
    """Return rows on what the pictures do not determine."""
    rows = []
    if depth > OBSERVED_MM:
        rows.append(("depth", "the views do not see depth", f"{depth:.1f} mm standard deviation"))
    if misfit > _MISFIT:
        reason = "the labels do not fit this frame in these cameras: nothing counts as observed"
        rows.append(("misfit", reason, f"{misfit:.0%} of the labels are off"))
    if not bend_found:
        rows.append(
            ("unfinished", "the budget ended before the bend was found: nothing counts as observed", "")
        )
    if given.head is not None and not visible.any():
        rows.append(("head", "the head hides all of the frame: is it in the cameras' frame and unit?", ""))
    hidden = given.known & ~visible.any(0)
    uncertain = given.known & ~hidden & (deviation > OBSERVED_MM)
    for lost, why in ((hidden, "hidden in all views"), (uncertain, "seen, but not well enough")):
        if lost.any():
            worst = f"up to {deviation[lost].max():.1f} mm standard deviation"
            rows.append(("unobserved", f"{int(lost.sum())} key points are {why}", worst))
    if wrong.any():
        names = ", ".join(name for name, bad in zip(KEY_POINT_NAMES, wrong, strict=True) if bad)
        rows.append(("contradicted", "masks show them elsewhere or not at all", names))
    return Plan(tuple(PlanStep(f"glasses.{step}", False, reason, found) for step, reason, found in rows))
