"""Before anything bends: pose and size over the rigid regions, then the face's proportions.

Where a person's eyes, nose and mouth stand at other heights than the model's, closest points alone let the
sheet slide along the face. So a few numbers that keep the face's symmetry and its features whole are found
first; the bending starts from there.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import BSpline

from scan2albedo.core import Meter
from scan2albedo.core.arrays import FloatArray
from scan2albedo.fitting.forces import ForceGates, ScanForces, scan_forces
from scan2albedo.fitting.landmark_pull import LandmarkPull
from scan2albedo.fitting.options import GATE_MM, FitOptions, between
from scan2albedo.fitting.samples import SurfaceSamples
from scan2albedo.fitting.scan_surface import ScanSurface
from scan2albedo.geometry.rigid import Similarity, rotation_from_vector

SETTLED_MM = 0.01
SEARCH_EVERY = 6
GATE_SHRINK = 0.85
REACH_PER_MEDIAN = 5.0
SCALE_PRIOR = 0.02
"""Weight of the prior that pulls the scale to 1, relative to that of all samples together."""
KNOTS = 5
"""Quadratic B-splines over the height of the face."""
HALF_WIDTH_MM = 60.0
LEVEL_MM = 13.0
STEP_MM = 1.3
"""Standard deviations of a coefficient, and of the difference between neighbouring ones."""
NOISE_MM = 1.5
INDEPENDENT_SAMPLES = 300
"""Neighbouring residuals are correlated: against the prior they count as this many independent ones."""
LAST_GATE_MM = 6.0
ROBUST_MM = (3.0, 1.5)


def refine_similarity(
    scan: ScanSurface,
    samples: SurfaceSamples,
    rest: FloatArray,
    weight: FloatArray,
    gates: tuple[ForceGates, ForceGates],
    *,
    iterations: int,
    scale_range: tuple[float, float],
    meter: Meter,
    landmarks: LandmarkPull | None = None,
) -> Similarity:
    """Return the similarity that moves the model's rigid regions onto the scan, from its present pose.

    Gauss-Newton on (rotation, translation, log scale) of

        sum_i w_i [ (n_i . d_i)^2 + t |d_i - (n_i . d_i) n_i|^2 ],   d_i = y_i - x_i,

    with the closest points y_i, normals n_i and gated robust weights renewed every iteration. `rest` (C, 3)
    are the control points, `weight` (N,) of each sample its area times how much a motion shows there; the
    distance gate shrinks from the first of `gates` to the last. `landmarks` add their own d_i, whole.
    """
    points = samples.matrix @ rest
    placed = np.empty((0, 3)) if landmarks is None else landmarks.matrix @ rest
    pose = Similarity(np.eye(3), np.zeros(3))
    wide, narrow = gates
    reach = wide.distance_mm
    forces: ScanForces | None = None
    for iteration in range(iterations):
        if iteration and meter.exhausted:
            break
        start = forces if forces is not None and iteration % SEARCH_EVERY else None
        moved = pose.apply(points)
        gate = ForceGates(reach, wide.tangential, narrow.min_robust_mm)
        forces = scan_forces(scan, moved, samples.normals(moved), gate, start)
        meter.count()
        meter.record(forces.mean_distance_mm(samples.area))
        if not forces.weight.any():
            break
        drawn, offset, pull = _drawn(landmarks, pose.apply(placed))
        step = _gauss_newton_step(
            np.vstack([moved, drawn]),
            np.vstack([forces.offset, offset]),
            np.vstack([forces.normal, np.zeros_like(drawn)]),
            np.concatenate([weight * forces.weight, pull]),
            np.concatenate([np.full(len(moved), gate.tangential), np.ones(len(drawn))]),
            pose.scale,
        )
        pose = _updated(pose, step, scale_range)
        if _largest_motion(step, points) < SETTLED_MM and reach <= narrow.distance_mm:
            break
        reach = max(_next_reach(forces, reach), narrow.distance_mm)
    return pose


def _drawn(landmarks: LandmarkPull | None, points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the model's landmarks (L, 3) as given, their offsets (L, 3) to the targets and weights (L,)."""
    if landmarks is None:
        return points, points, np.empty(0)
    offset = landmarks.seen_offsets(points)
    return points, offset, landmarks.person_weight(offset)


def _next_reach(forces: ScanForces, reach: float) -> float:
    """Shrink the gate, but never below several times the distance of half of the samples."""
    needed = REACH_PER_MEDIAN * float(np.median(np.linalg.norm(forces.offset, axis=1)[forces.weight > 0]))
    return min(reach, max(GATE_SHRINK * reach, needed))


def _gauss_newton_step(
    points: FloatArray,
    offset: FloatArray,
    normal: FloatArray,
    weight: FloatArray,
    tangential: FloatArray,
    scale: float,
) -> FloatArray:
    """Return (7,) increments: rotation vector, translation, log scale."""
    count = len(points)
    jacobian = np.zeros((count, 3, 7))
    x, y, z = points.T
    jacobian[:, 0, 1], jacobian[:, 0, 2] = z, -y
    jacobian[:, 1, 0], jacobian[:, 1, 2] = -z, x
    jacobian[:, 2, 0], jacobian[:, 2, 1] = y, -x
    jacobian[:, [0, 1, 2], [3, 4, 5]] = 1.0
    jacobian[:, :, 6] = points
    across = np.einsum("nij,ni->nj", jacobian, normal)
    gap = np.einsum("ni,ni->n", offset, normal)
    heavy, light = weight * (1 - tangential), weight * tangential
    flat = jacobian.reshape(-1, 7)
    spread = np.repeat(light, 3)
    system = (across * heavy[:, None]).T @ across + (flat * spread[:, None]).T @ flat
    right = across.T @ (heavy * gap) + flat.T @ (spread * offset.ravel())
    prior = SCALE_PRIOR * float(weight @ np.sum(points**2, axis=1))
    system[6, 6] += prior
    right[6] -= prior * np.log(scale)
    size = np.sqrt(np.maximum(np.diag(system), 1e-300))
    scaled = system / np.outer(size, size) + 1e-6 * np.eye(7)
    return np.linalg.solve(scaled, right / size) / size


def _updated(pose: Similarity, step: FloatArray, scale_range: tuple[float, float]) -> Similarity:
    turn = rotation_from_vector(step[:3])
    scale = float(np.clip(pose.scale * np.exp(np.clip(step[6], -0.2, 0.2)), *scale_range))
    growth = scale / pose.scale
    return Similarity(turn @ pose.rotation, growth * turn @ pose.translation + step[3:6], scale)


def _largest_motion(step: FloatArray, points: FloatArray) -> float:
    radius = float(np.sqrt(np.mean(np.sum(points**2, axis=1))))
    return float(np.linalg.norm(step[3:6]) + radius * (np.linalg.norm(step[:3]) + abs(step[6])))


def proportioned(
    scan: ScanSurface,
    samples: SurfaceSamples,
    reference: FloatArray,
    options: FitOptions,
    meter: Meter,
    landmarks: LandmarkPull | None = None,
) -> FloatArray:
    """Return control points (C, 3) whose face has the scan's proportions.

    Gauss-Newton, `proportion_iterations` steps, on a rigid motion and three splines of height (`_modes`),
    point to plane with the gates and robust weights of the forces, against a Gaussian prior on the splines.
    `reference` (C, 3) are control points at rest, in the scan's frame and about of its size; `landmarks` are
    drawn to their targets as far as the splines allow.
    """
    modes, precision = _modes(reference)
    moves = np.stack([samples.matrix @ modes[:, axis] for axis in range(3)], axis=1)
    rest = samples.matrix @ reference
    found = np.zeros(modes.shape[2])
    steps = options.proportion_iterations
    for step in range(steps):
        if meter.exhausted:
            break
        progress = step / max(steps - 1, 1)
        points = rest + moves @ found
        gates = ForceGates(
            between((GATE_MM[0], LAST_GATE_MM), progress),
            options.tangential,
            between(ROBUST_MM, progress),
        )
        forces = scan_forces(scan, points, samples.normals(points), gates, rim=samples.rim)
        meter.count()
        meter.record(forces.mean_distance_mm(samples.area))
        weight = samples.area * samples.rigidity * forces.weight
        if not weight.any():
            break
        across = np.einsum("nij,ni->nj", moves, forces.normal)
        gap = np.einsum("ni,ni->n", forces.offset, forces.normal)
        prior = weight.sum() * NOISE_MM**2 / INDEPENDENT_SAMPLES * precision
        system = across.T @ (weight[:, None] * across) + prior
        right = across.T @ (weight * gap) - prior @ found
        if landmarks is not None:
            whole = np.stack([landmarks.matrix @ modes[:, axis] for axis in range(3)], axis=1)
            offset = landmarks.offsets(reference + modes @ found)
            pulled = landmarks.person_weight(offset)[:, None, None] * whole
            system += np.einsum("lij,lik->jk", pulled, whole)
            right += np.einsum("lij,li->j", pulled, offset)
        found = found + np.linalg.solve(system, right)
    return reference + modes @ found


def _modes(reference: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return displacements (C, 3, M) of the control points a unit of each mode, and their precision (M, M).

    Six rigid modes (free but for a trace), then per spline of height: shift up, shift forward, and forward
    with the square of x (how round the face is), all mirror-symmetric.
    """
    centred = reference - reference.mean(0)
    height = (centred[:, 1] - centred[:, 1].min()) / max(np.ptp(centred[:, 1]), 1e-9)
    knots = np.concatenate([[0.0, 0.0], np.linspace(0, 1, KNOTS - 1), [1.0, 1.0]])
    spline = BSpline.design_matrix(np.clip(height, 0, 1 - 1e-9), knots, 2).toarray()
    modes = np.zeros((len(reference), 3, 6 + 3 * KNOTS))
    for axis in range(3):
        unit = np.eye(3)[axis]
        modes[:, :, axis] = np.cross(unit, centred) / HALF_WIDTH_MM
        modes[:, :, 3 + axis] = unit
    up, forward, round_ = (slice(6 + i * KNOTS, 6 + (i + 1) * KNOTS) for i in range(3))
    modes[:, 1, up] = spline
    modes[:, 2, forward] = spline
    modes[:, 2, round_] = 0.5 * (centred[:, 0, None] / HALF_WIDTH_MM) ** 2 * spline
    difference = np.diff(np.eye(KNOTS), axis=0)
    precision = np.zeros((modes.shape[2], modes.shape[2]))
    precision[:6, :6] = 1e-6 * np.eye(6)
    for block in (up, forward, round_):
        precision[block, block] = difference.T @ difference / STEP_MM**2 + np.eye(KNOTS) / LEVEL_MM**2
    return modes, precision
