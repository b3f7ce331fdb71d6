"""How well the pictures fix a frame, where they contradict it, and the result in the caller's unit."""

from dataclasses import replace

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree
from scipy.special import erfinv, log_ndtr

from scan2albedo.core import Meter, Plan, PlanStep
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES
from scan2albedo.eyeglasses.on_face.frame_motion import FrameMotion
from scan2albedo.eyeglasses.on_face.inputs import OBSERVED_MM, RegisteredEyeglasses, RegistrationInputs
from scan2albedo.eyeglasses.on_face.objective import FrameEstimate, Linearization, RegistrationObjective
from scan2albedo.eyeglasses.on_face.outline import ObservedView, OutlineSampler, color_odds, hidden_by
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.pinhole import camera_centers, project, projected

_MODEL_MM, _MODEL_BENT = 0.06, 0.21
"""What key points and weights cannot follow: at rest, and where they shift by 1 mm; it grows as the root."""
_ONE_VIEW, _ONE_VIEW_RESTED = 2.0, 1.4
"""Errors over stated deviations, measured on 26 wearers seen from one place, free and resting on the nose."""
_APART = 0.02
"""Distance of cameras, as a part of that to the frame, from which they count as two places."""
_ANYWHERE_MM = 1e6
"""Deviation of a point that nothing determines: finite, so that products with weights of 0 stay 0."""
WORN_MM = 40.0
"""Distance of the frame from the head beyond which nobody wears it."""
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
    options, state, unit = objective.options, found.state, given.unit
    motion = objective.motion(state)
    # Behind the frame's own points there may be those of lenses that only masks show.
    points = sampler.mesh.points[: len(given.vertices)]
    marks = motion.marks
    vertices, keypoints = motion.positions(points), motion.positions(marks)
    samples = sampler.sample(motion, mark_deviations(given, motion, found.at))
    rigid = not options.bend
    at = objective.linearize(state, samples, rigid=rigid)
    # Deviations from the Gauss-Newton matrix, labels and outlines weighted by the noise that they show.
    labels = at.labels_px[np.isfinite(at.labels_px)]
    outline = np.abs(at.outline_px)
    label_px, outline_px = options.label_noise_px, options.outline_noise_px
    if len(labels) > 4:
        # Over the medians of a distance in the plane (Rayleigh) and of an error, at a deviation of 1.
        label_px = max(_LEAST_NOISE_PX, float(np.median(labels) / np.sqrt(2 * np.log(2))))
    if len(outline) > 4:
        outline_px = max(_LEAST_NOISE_PX, float(np.median(outline) / (np.sqrt(2) * erfinv(0.5))))
    shown = replace(options, label_noise_px=label_px, outline_noise_px=outline_px)
    weighted = RegistrationObjective(objective.keypoints, objective.views, shown, objective.contact)
    root = _root(weighted.linearize(state, samples, rigid=rigid).matrix)
    visible = np.stack([_visible(sampler, view, vertices) for view in given.views])
    marks_visible = np.stack([_visible(sampler, view, keypoints) for view in given.views]) & given.known
    covariances = motion.covariances(marks, root)
    # Pictures from one place leave more open than the matrix says.
    inflation = 1.0
    if used := [v for v in given.views if v.outlined or np.isfinite(v.labels).all(1).any()]:
        centers = camera_centers(np.stack([view.camera for view in used]))
        away = np.linalg.norm(keypoints[given.known].mean(0) - centers[0])
        if np.linalg.norm(centers - centers[0], axis=1).max() <= _APART * away:
            inflation = _ONE_VIEW if objective.contact is None else _ONE_VIEW_RESTED
    stated = []
    for p, c in ((points, motion.covariances(points, root)), (marks, covariances)):
        # Frames bend otherwise than their key points say.
        bend_mm = p.weights @ np.linalg.norm(state.shifts, axis=1)
        unmodelled = np.hypot(_MODEL_MM, _MODEL_BENT * np.sqrt(np.maximum(bend_mm, 0.0)))
        distance = np.sqrt(np.maximum(np.trace(c, axis1=1, axis2=2), 0.0))
        stated.append(np.hypot(inflation * distance, unmodelled))
    deviation, mark_deviation = stated
    depth = inflation * _depth_deviation(given.views, keypoints, covariances, marks_visible)
    # With more than a third of the labels off, which are the right ones is a guess.
    errors = at.labels_px[~np.isnan(at.labels_px)]
    misfit = float((errors > 3 * options.label_noise_px).mean()) if len(errors) else 0.0
    trusted = bend_found and misfit <= 1 / 3
    count = len(given.views)
    outline_rms, iou, differing = np.full(count, np.nan), np.full(count, np.nan), np.zeros(len(keypoints))
    for number, (view, mask) in enumerate(zip(given.views, given.masks, strict=True)):
        seen = at.outline_px[samples.view == number]
        if len(seen):
            outline_rms[number] = np.sqrt(np.mean(seen**2))
        if mask is not None and view.distance is not None:
            iou[number], here = compare_masks(sampler, motion, number, mask, outline_px)
            differing = np.maximum(differing, here)
    # More pixels than 25 are a patch as wide as a temple.
    wrong = (differing > 25) & given.known
    # What pictures show: the key points whose surroundings were found there, and the frame's pixels.
    proposed, proposed_px = (np.full((count, len(keypoints), *size), np.nan) for size in ((2,), ()))
    masks: list[BoolArray | None] = [None] * count
    scale = mark_deviation**2 / np.maximum(np.trace(covariances, axis1=1, axis2=2), 1e-12)
    proposals = []
    for number, view in enumerate(given.views):
        if view.colors is None:
            continue
        pixels, slopes, _ = projected(view.camera[None], keypoints)
        spread = np.einsum("kij,kjl,kml->kim", slopes, covariances, slopes)
        spread *= scale[:, None, None]
        sought = marks_visible[number] & np.isnan(view.labels).any(1) & (mark_deviation <= OBSERVED_MM)
        with np.errstate(invalid="ignore"):
            sought &= samples.share[number] > 0.5
        proposed[number, sought] = pixels[sought]
        proposed_px[number, sought] = np.sqrt(scale * np.trace(spread, axis1=1, axis2=2) / 2)[sought]
        sure = [f"{KEY_POINT_NAMES[k]} {proposed_px[number, k]:.1f}" for k in np.flatnonzero(sought)]
        reason = f"{len(sure) or 'no'} key points of view {number} are proposed from its picture"
        evidence = f"standard deviations in px: {', '.join(sure)}" if sure else ""
        proposals.append(PlanStep("glasses.proposed", bool(sure), reason, evidence))
        # Bayes: of a pixel's distance from the outline, as sure as the outline is, and of its colour.
        frame, _ = sampler.mask(motion, number)
        inward = (distance_transform_edt(frame) - distance_transform_edt(~frame)) / outline_px
        masks[number] = log_ndtr(inward) - log_ndtr(-inward) + color_odds(view.colors, frame) > 0
    rows = []
    if depth > OBSERVED_MM:
        rows.append(("depth", "the views do not see depth", f"{depth:.1f} mm standard deviation"))
    if misfit > 1 / 3:
        reason = "the labels do not fit this frame in these cameras: nothing counts as observed"
        rows.append(("misfit", reason, f"{misfit:.0%} of the labels are off"))
    if not bend_found:
        reason = "the budget ended before the bend was found: nothing counts as observed"
        rows.append(("unfinished", reason, ""))
    if not found.converged:
        reason = "not converged: the plan says which step, and a longer budget may end it"
        rows.append(("unconverged", reason, ""))
    if given.head is not None:
        apart = float(ClosestPointQuery(*given.head).query(keypoints[given.known]).distance.min())
        if apart > WORN_MM:
            reason = f"the head is {apart:.0f} mm or more from the frame: are head and cameras in one frame?"
            rows.append(("head", reason, ""))
        if not marks_visible.any():
            reason = "the head hides all of the frame: is it in the cameras' frame and unit?"
            rows.append(("head", reason, ""))
    if wrong.any():
        names = ", ".join(name for name, bad in zip(KEY_POINT_NAMES, wrong, strict=True) if bad)
        rows.append(("contradicted", "masks show them elsewhere or not at all", names))
    said = proposals + [PlanStep.doubt(f"glasses.{row[0]}", *row[1:]) for row in rows]
    hidden = given.known & ~marks_visible.any(0)
    uncertain = given.known & ~hidden & (mark_deviation > OBSERVED_MM)
    for lost, why in ((hidden, "hidden in all views"), (uncertain, "seen, but not well enough")):
        if lost.any():
            worst = f"up to {mark_deviation[lost].max():.1f} mm standard deviation"
            reason = f"{int(lost.sum())} key points are {why}"
            said.append(PlanStep("glasses.unobserved", False, reason, worst))
    world, transforms = motion.world_from_frame.copy(), motion.transforms.copy()
    world[:3, 3] *= unit
    transforms[:, :3, 3] *= unit
    known = np.where(given.known, 1.0, np.nan)
    return RegisteredEyeglasses(
        vertices=unit * vertices, faces=given.faces, weights=points.weights,
        keypoints=unit * keypoints * known[:, None], world_from_glasses=world, handle_transforms=transforms,
        bend=unit * state.shifts, visible=visible, deviation=unit * deviation,
        observed=trusted & visible.any(0) & (deviation <= OBSERVED_MM) & ~wrong[points.weights.argmax(1)],
        keypoint_deviation=unit * mark_deviation * known,
        keypoints_observed=trusted & marks_visible.any(0) & (mark_deviation <= OBSERVED_MM) & ~wrong,
        depth_deviation=unit * depth,
        depth_observed=bool(trusted and depth <= OBSERVED_MM and inflation < _ONE_VIEW),
        label_errors_px=at.labels_px, inliers=at.labels_px <= 3 * options.label_noise_px,
        outline_rms_px=outline_rms, iou=iou, proposed_labels=proposed, proposed_deviation_px=proposed_px,
        proposed_masks=tuple(masks), converged=found.converged, iterations=meter.evaluations,
        plan=plan + said, trace=meter.trace,
    )  # fmt: skip


def _root(matrix: FloatArray) -> FloatArray:
    """Return a root (P, P) of the inverse of a Gauss-Newton matrix of squared deviations."""
    scale = np.sqrt(np.maximum(np.diag(matrix), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(matrix / scale[:, None] / scale)
    # Open directions stay finite.
    values = np.maximum(values, values.max() / _ANYWHERE_MM**2)
    return np.asarray(vectors / np.sqrt(values) / scale[:, None])


def depth_open(given: RegistrationInputs, motion: FrameMotion, at: Linearization) -> float:
    """Return the standard deviation of the key points along the line of sight, mm, the head left aside."""
    if not given.labelled:
        return _ANYWHERE_MM
    covariances = motion.covariances(motion.marks, _root(at.matrix))
    seen = np.tile(given.known, (len(given.views), 1))
    return _depth_deviation(given.views, motion.positions(motion.marks), covariances, seen)


def mark_deviations(given: RegistrationInputs, motion: FrameMotion, at: Linearization) -> FloatArray:
    """Return (20,) standard deviations in mm of the key points, each in its worst direction."""
    if not given.labelled and len(at.outline_px) == 0:
        return np.full(len(given.keypoints), _ANYWHERE_MM)
    covariances = motion.covariances(motion.marks, _root(at.matrix))
    return np.sqrt(np.maximum(np.linalg.eigvalsh(covariances)[:, -1], 0.0))


def _visible(sampler: OutlineSampler, view: ObservedView, points: FloatArray) -> BoolArray:
    pixels, depth = project(view.camera, points)
    inside = depth > 0
    if view.shape is not None:
        with np.errstate(invalid="ignore"):
            inside &= ((pixels >= -0.5) & (pixels <= np.array(view.shape[::-1]) - 0.5)).all(1)
    return inside & ~hidden_by(sampler.head, view.camera, points)


def _depth_deviation(
    views: tuple[ObservedView, ...], keypoints: FloatArray, covariances: FloatArray, visible: BoolArray
) -> float:
    """Return the root mean square deviation along each view's rays, of the view that knows depth best."""
    best = np.inf
    for view, seen in zip(views, visible, strict=True):
        if seen.any():
            rays = normalized(keypoints[seen] - camera_centers(view.camera[None])[0])
            variance = np.maximum(np.einsum("ni,nij,nj->n", rays, covariances[seen], rays), 0.0)
            best = min(best, float(np.sqrt(variance.mean())))
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
    return float((own & mask).sum() / union.sum()), differing
