"""How well the pictures fix a frame, where they contradict it, and the result in the caller's unit."""

from dataclasses import dataclass, replace
from itertools import compress

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree
from scipy.special import erfinv, log_ndtr

from scan2albedo.core import Meter, Plan, PlanStep
from scan2albedo.core.arrays import SMALLEST, BoolArray, FloatArray, finite_rows, norms, rms
from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES
from scan2albedo.eyeglasses.on_face.frame_motion import FrameMotion, SkinnedPoints
from scan2albedo.eyeglasses.on_face.inputs import (
    OBSERVED_MM,
    FaceRegistrationOptions,
    RegisteredEyeglasses,
    RegistrationInputs,
)
from scan2albedo.eyeglasses.on_face.objective import FrameEstimate, Linearization, RegistrationObjective
from scan2albedo.eyeglasses.on_face.outline import (
    ObservedView,
    OutlineSampler,
    OutlineSamples,
    color_odds,
    hidden_by,
)
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.pinhole import camera_centers, project, projected
from scan2albedo.geometry.rasterization import within

_MODEL_MM = 0.06
"""What key points and weights cannot follow of a frame at rest."""
_MODEL_BENT = 0.21
"""mm that they cannot follow where key points shift by 1 mm; it grows as the root."""
_ONE_VIEW = 2.0
"""Errors over stated deviations of frames seen from one place, measured on 26 wearers."""
_ONE_VIEW_RESTED = 1.4
"""The same of frames that rest on the nose."""
_APART = 0.02
"""Distance of cameras, as a part of that to the frame, from which they count as two places."""
_ANYWHERE_MM = 1e6
"""Deviation of a point that nothing determines: finite, so that products with weights of 0 stay 0."""
WORN_MM = 40.0
"""Distance of the frame from the head beyond which nobody wears it."""
_LEAST_NOISE_PX = 0.3
"""Below it pixels and the bend's model limit the accuracy, not labels."""


def report(
    inputs: RegistrationInputs,
    sampler: OutlineSampler,
    objective: RegistrationObjective,
    found: FrameEstimate,
    *,
    bend_found: bool,
    meter: Meter,
    plan: Plan,
) -> RegisteredEyeglasses:
    """Return the result of a registration that ended in `found`."""
    options, state, unit = objective.options, found.state, inputs.unit
    motion = objective.motion(state)
    # Behind the frame's own points there may be those of lenses that only masks show.
    points = sampler.mesh.points[: len(inputs.vertices)]
    vertices, keypoints = motion.positions(points), motion.positions(motion.marks)
    samples = sampler.sample(motion, mark_deviations(inputs, motion, found.at))
    at = objective.linearize(state, samples, rigid=not options.bend)
    shown = _noise_shown(options, at)
    known_to = _certainty(inputs, objective, shown, motion, points, samples)
    visible = np.stack([_visible(sampler, view, vertices) for view in inputs.views])
    marks_visible = np.stack([_visible(sampler, view, keypoints) for view in inputs.views]) & inputs.known
    depth = known_to.inflation * _depth_deviation(
        inputs.views, keypoints, known_to.covariances, marks_visible
    )
    # With more than a third of the labels off, which are the right ones is a guess.
    errors = at.labels_px[~np.isnan(at.labels_px)]
    misfit = (errors > 3 * options.label_noise_px).mean() if len(errors) else 0.0
    trusted = bend_found and misfit <= 1 / 3
    outline_rms_px, iou, differing = _fit_to_masks(
        inputs, sampler, motion, samples, at, shown.outline_noise_px
    )
    # More pixels than 25 are a patch as wide as a temple.
    wrong = (differing > 25) & inputs.known
    sought = marks_visible & (known_to.keypoints <= OBSERVED_MM)
    labels, deviations_px, masks, rows = _propose(
        inputs, sampler, motion, samples, known_to, sought, shown.outline_noise_px
    )
    apart = 0.0
    if inputs.head is not None:
        apart = ClosestPointQuery(*inputs.head).query(keypoints[inputs.known]).distance.min()
    names = ", ".join(compress(KEY_POINT_NAMES, wrong))
    nothing = "nothing counts as observed"
    doubts = (
        (depth > OBSERVED_MM, "depth", "the views do not see depth", f"{depth:.1f} mm standard deviation"),
        (
            misfit > 1 / 3,
            "misfit",
            f"the labels do not fit this frame in these cameras: {nothing}",
            f"{misfit:.0%} of the labels are off",
        ),
        (not bend_found, "unfinished", f"the budget ended before the bend was found: {nothing}", ""),
        (
            not found.converged,
            "unconverged",
            "not converged: the plan says which step, and a longer budget may end it",
            "",
        ),
        (
            apart > WORN_MM,
            "head",
            f"the head is {apart:.0f} mm or more from the frame: are head and cameras in one frame?",
            "",
        ),
        (
            inputs.head is not None and not marks_visible.any(),
            "head",
            "the head hides all of the frame: is it in the cameras' frame and unit?",
            "",
        ),
        (wrong.any(), "contradicted", "masks show them elsewhere or not at all", names),
    )
    rows += [PlanStep.doubt(f"glasses.{name}", *said) for holds, name, *said in doubts if holds]
    hidden = inputs.known & ~marks_visible.any(0)
    uncertain = inputs.known & ~hidden & (known_to.keypoints > OBSERVED_MM)
    for lost, why in ((hidden, "hidden in all views"), (uncertain, "seen, but not well enough")):
        if lost.any():
            worst = f"up to {known_to.keypoints[lost].max():.1f} mm standard deviation"
            reason = f"{lost.sum()} key points are {why}"
            rows.append(PlanStep("glasses.unobserved", False, reason, worst))
    world, transforms = motion.world_from_frame.copy(), motion.transforms.copy()
    world[:3, 3] *= unit
    transforms[:, :3, 3] *= unit
    known = np.where(inputs.known, 1.0, np.nan)
    near = known_to.vertices <= OBSERVED_MM
    return RegisteredEyeglasses(
        vertices=unit * vertices,
        faces=inputs.faces,
        weights=points.weights,
        keypoints=unit * keypoints * known[:, None],
        world_from_glasses=world,
        handle_transforms=transforms,
        bend=unit * state.shifts,
        visible=visible,
        deviation=unit * known_to.vertices,
        observed=trusted & visible.any(0) & near & ~wrong[points.weights.argmax(1)],
        keypoint_deviation=unit * known_to.keypoints * known,
        keypoints_observed=trusted & sought.any(0) & ~wrong,
        depth_deviation=unit * depth,
        depth_observed=bool(trusted and depth <= OBSERVED_MM and known_to.inflation < _ONE_VIEW),
        label_errors_px=at.labels_px,
        inliers=at.labels_px <= 3 * options.label_noise_px,
        outline_rms_px=outline_rms_px,
        iou=iou,
        proposed_labels=labels,
        proposed_deviation_px=deviations_px,
        proposed_masks=tuple(masks),
        converged=found.converged,
        iterations=meter.evaluations,
        plan=plan + rows,
        trace=meter.trace,
    )


def _noise_shown(options: FaceRegistrationOptions, at: Linearization) -> FaceRegistrationOptions:
    """Return the options with the noise that labels and outlines show, where there are enough of them."""
    labels = at.labels_px[np.isfinite(at.labels_px)]
    # Over the medians of a distance in the plane (Rayleigh) and of an error, at a deviation of 1.
    if len(labels) > 4:
        noise_px = np.median(labels) / np.sqrt(2 * np.log(2))
        options = replace(options, label_noise_px=max(_LEAST_NOISE_PX, noise_px))
    if len(at.outline_px) > 4:
        noise_px = np.median(np.abs(at.outline_px)) / (np.sqrt(2) * erfinv(0.5))
        options = replace(options, outline_noise_px=max(_LEAST_NOISE_PX, noise_px))
    return options


@dataclass(frozen=True)
class _Certainty:
    """How well the pictures fix a frame.

    `vertices` (V,) and `keypoints` (20,) are their deviations in mm. `covariances` (20, 3, 3) of the key
    points are those of the Gauss-Newton matrix alone, before the `inflation` of pictures from one place.
    """

    vertices: FloatArray
    keypoints: FloatArray
    covariances: FloatArray
    inflation: float


def _certainty(
    inputs: RegistrationInputs,
    objective: RegistrationObjective,
    shown: FaceRegistrationOptions,
    motion: FrameMotion,
    points: SkinnedPoints,
    samples: OutlineSamples,
) -> _Certainty:
    """Return deviations from the Gauss-Newton matrix, labels and outlines weighted by the noise `shown`."""
    weighted = RegistrationObjective(objective.keypoints, objective.views, shown, objective.contact)
    root = _root(weighted.linearize(motion.state, samples, rigid=not shown.bend).matrix)
    # Pictures from one place leave more open than the matrix says.
    inflation = 1.0
    used = [view for view in inputs.views if view.outlined or finite_rows(view.labels).any()]
    if used:
        centers = camera_centers(np.stack([view.camera for view in used]))
        away = np.linalg.norm(motion.positions(motion.marks)[inputs.known].mean(0) - centers[0])
        if norms(centers - centers[0]).max() <= _APART * away:
            inflation = _ONE_VIEW if objective.contact is None else _ONE_VIEW_RESTED

    def deviations(of: SkinnedPoints, covariances: FloatArray) -> FloatArray:
        # Frames bend otherwise than their key points say.
        bend_mm = of.weights @ norms(motion.state.shifts)
        unmodelled = np.hypot(_MODEL_MM, _MODEL_BENT * np.sqrt(np.maximum(bend_mm, 0.0)))
        distance = np.sqrt(np.maximum(np.trace(covariances, axis1=1, axis2=2), 0.0))
        return np.hypot(inflation * distance, unmodelled)

    of_marks = motion.covariances(motion.marks, root)
    return _Certainty(
        vertices=deviations(points, motion.covariances(points, root)),
        keypoints=deviations(motion.marks, of_marks),
        covariances=of_marks,
        inflation=inflation,
    )


def _fit_to_masks(
    inputs: RegistrationInputs,
    sampler: OutlineSampler,
    motion: FrameMotion,
    samples: OutlineSamples,
    at: Linearization,
    noise_px: float,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return outlines' distances, intersections over unions (C,), and differing pixels by key point (20,)."""
    outline_rms, iou = np.full((2, len(inputs.views)), np.nan)
    differing = np.zeros(len(inputs.keypoints))
    for number, (view, mask) in enumerate(zip(inputs.views, inputs.masks, strict=True)):
        seen = at.outline_px[samples.view == number]
        if len(seen):
            outline_rms[number] = rms(seen)
        if mask is not None and view.distance is not None:
            iou[number], here = compare_masks(sampler, motion, number, mask, noise_px)
            differing = np.maximum(differing, here)
    return outline_rms, iou, differing


def _propose(
    inputs: RegistrationInputs,
    sampler: OutlineSampler,
    motion: FrameMotion,
    samples: OutlineSamples,
    known_to: _Certainty,
    sought: BoolArray,
    noise_px: float,
) -> tuple[FloatArray, FloatArray, list[BoolArray | None], list[PlanStep]]:
    """Return what pictures show of the `sought` (C, 20) key points, and the frame's pixels in them.

    Labels (C, 20, 2), their deviations (C, 20) px, masks (H, W), and plan steps.
    """
    keypoints, covariances = motion.positions(motion.marks), known_to.covariances
    labels, deviations_px = np.full((*sought.shape, 2), np.nan), np.full(sought.shape, np.nan)
    masks: list[BoolArray | None] = [None] * len(sought)
    steps = []
    scale = known_to.keypoints**2 / np.maximum(np.trace(covariances, axis1=1, axis2=2), 1e-12)
    for number, view in enumerate(inputs.views):
        if view.colors is None:
            continue
        pixels, slopes, _ = projected(view.camera[None], keypoints)
        spread = np.einsum("kij,kjl,kml->kim", slopes, covariances, slopes)
        spread *= scale[:, None, None]
        here = sought[number] & np.isnan(view.labels).any(1)
        with np.errstate(invalid="ignore"):
            here &= samples.share[number] > 0.5
        deviation_px = np.sqrt(scale * np.trace(spread, axis1=1, axis2=2) / 2)
        labels[number, here] = pixels[here]
        deviations_px[number, here] = deviation_px[here]
        sure = [f"{KEY_POINT_NAMES[k]} {deviation_px[k]:.1f}" for k in np.flatnonzero(here)]
        reason = f"{len(sure) or 'no'} key points of view {number} are proposed from its picture"
        evidence = f"standard deviations in px: {', '.join(sure)}" if sure else ""
        steps.append(PlanStep("glasses.proposed", bool(sure), reason, evidence))
        # Bayes: of a pixel's distance from the outline, as sure as the outline is, and of its colour.
        frame, _ = sampler.mask(motion, number)
        inward = (distance_transform_edt(frame) - distance_transform_edt(~frame)) / noise_px
        masks[number] = log_ndtr(inward) - log_ndtr(-inward) + color_odds(view.colors, frame) > 0
    return labels, deviations_px, masks, steps


def _root(matrix: FloatArray) -> FloatArray:
    """Return a root (P, P) of the inverse of a Gauss-Newton matrix of squared deviations."""
    scale = np.sqrt(np.maximum(np.diag(matrix), SMALLEST))
    values, vectors = np.linalg.eigh(matrix / scale[:, None] / scale)
    # Open directions stay finite.
    values = np.maximum(values, values.max() / _ANYWHERE_MM**2)
    return vectors / np.sqrt(values) / scale[:, None]


def depth_open(inputs: RegistrationInputs, motion: FrameMotion, at: Linearization) -> float:
    """Return the standard deviation of the key points along the line of sight, mm, the head left aside."""
    if not inputs.labelled:
        return _ANYWHERE_MM
    covariances = motion.covariances(motion.marks, _root(at.matrix))
    seen = np.tile(inputs.known, (len(inputs.views), 1))
    return _depth_deviation(inputs.views, motion.positions(motion.marks), covariances, seen)


def mark_deviations(inputs: RegistrationInputs, motion: FrameMotion, at: Linearization) -> FloatArray:
    """Return (20,) standard deviations in mm of the key points, each in its worst direction."""
    if not inputs.labelled and len(at.outline_px) == 0:
        return np.full(len(inputs.keypoints), _ANYWHERE_MM)
    covariances = motion.covariances(motion.marks, _root(at.matrix))
    return np.sqrt(np.maximum(np.linalg.eigvalsh(covariances)[:, -1], 0.0))


def _visible(sampler: OutlineSampler, view: ObservedView, points: FloatArray) -> BoolArray:
    pixels, depth = project(view.camera, points)
    inside = depth > 0
    if view.shape is not None:
        inside &= within(pixels, view.shape, 0.5)
    return inside & ~hidden_by(sampler.head, view.camera, points)


def _depth_deviation(
    views: tuple[ObservedView, ...], keypoints: FloatArray, covariances: FloatArray, visible: BoolArray
) -> float:
    """Return the root mean square deviation along each view's rays, of the view that knows depth best."""
    best = np.inf
    for view, seen in zip(views, visible, strict=True):
        if seen.any():
            rays = normalized(keypoints[seen] - camera_centers(view.camera))
            variance = np.maximum(np.einsum("ni,nij,nj->n", rays, covariances[seen], rays), 0.0)
            best = min(best, np.sqrt(variance.mean()))
    return best


def compare_masks(
    sampler: OutlineSampler, motion: FrameMotion, number: int, mask: BoolArray, noise_px: float
) -> tuple[float, FloatArray]:
    """Return the intersection over the union of a view's mask (H, W) and the frame's, the head in front.

    Also (K,) pixels of either mask away from the other, by the key point of the nearest vertex.
    """
    vertices, weights = motion.positions(sampler.mesh.points), sampler.mesh.points.weights
    own, foremost = sampler.mask(motion, number)
    union, differing = own | mask, np.zeros(weights.shape[1])
    # Distances in the box around both masks are those of the whole picture.
    rows, columns = np.flatnonzero(union.any(1)), np.flatnonzero(union.any(0))
    box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    limit = 4 * max(noise_px, 1.0)
    for here, there in ((mask, own), (own, mask)):
        away = here[box] if not there.any() else here[box] & (distance_transform_edt(~there[box]) > limit)
        row, column = np.nonzero(away)
        row, column = row + rows[0], column + columns[0]
        if here is own:
            owner = foremost[row, column]
        else:
            # Vertices that the head should hide too: the mask may be what shows that it does not.
            pixels, depth = project(sampler.views[number].camera, vertices)
            front = np.flatnonzero(depth > 0)
            if not len(front):
                continue
            owner = front[cKDTree(pixels[front]).query(np.stack([column, row], 1))[1]]
        differing += weights[owner].sum(0)
    return (own & mask).sum() / union.sum(), differing
