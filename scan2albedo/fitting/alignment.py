"""Before anything bends: pose and size over the rigid regions, then the face's proportions.

Closest points alone let the sheet slide along a face whose eyes, nose and mouth stand at other heights.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.interpolate import BSpline
from scipy.linalg import block_diag

from scan2albedo.core import Meter
from scan2albedo.core.arrays import FloatArray
from scan2albedo.fitting.forces import ForceGates, ScanForces, scan_forces
from scan2albedo.fitting.landmark_pull import LandmarkPull
from scan2albedo.fitting.options import GATE_MM, FitOptions, between
from scan2albedo.fitting.samples import SurfaceSamples
from scan2albedo.fitting.scan_surface import ScanSurface
from scan2albedo.geometry.alignment import Alignment, Pairs, align
from scan2albedo.geometry.rigid import Similarity

NOISE_MM = 1.5
"""Standard deviation of the distance between the scan and a model in the person's shape."""
SIZE_SD = 0.012
"""Of the logarithm of the size about the registration's, which the rigid regions alone hardly show."""
KNOTS = 5
"""Quadratic B-splines over the height of the face."""
LEVEL_MM, STEP_MM = 13.0, 1.3
"""Standard deviations of a coefficient, and of the difference between neighbouring ones."""
LAST_GATE_MM, ROBUST_MM = 6.0, (3.0, 1.5)


def refine_similarity(
    scan: ScanSurface,
    samples: SurfaceSamples,
    rest: FloatArray,
    weight: FloatArray,
    gates: ForceGates,
    *,
    iterations: int,
    scale_range: tuple[float, float],
    meter: Meter,
    landmarks: LandmarkPull | None = None,
) -> Similarity:
    """Return the similarity that moves rigid regions of control points `rest` (C, 3) onto the scan."""
    forces: ScanForces | None = None

    def pairs(now: Alignment, points: FloatArray) -> Pairs | None:
        nonlocal forces
        if now.steps and meter.exhausted:
            return None
        on_face = points[: len(weight)]
        forces = scan_forces(scan, on_face, samples.normals(on_face), gates, forces)
        return with_landmarks(forces, samples, landmarks, points, meter)

    matrix, weights = source(samples, weight, landmarks)
    known = np.array([[SIZE_SD**-2]])
    return align(
        matrix @ rest, weights, pairs, steps=iterations, precision=known, scale_range=scale_range
    ).pose


def source(
    samples: SurfaceSamples, weight: FloatArray, landmarks: LandmarkPull | None
) -> tuple[sparse.csr_matrix, FloatArray]:
    """Return the matrix (N + L, C) from control points to samples and then landmarks, and their weights."""
    if landmarks is None:
        return samples.matrix, weight
    matrix = sparse.vstack([samples.matrix, landmarks.matrix]).tocsr()
    return matrix, np.concatenate([weight, np.ones(len(landmarks.targets))])


def with_landmarks(
    forces: ScanForces, samples: SurfaceSamples, pull: LandmarkPull | None, points: FloatArray, meter: Meter
) -> Pairs | None:
    """Return the pairs of forces and landmarks at `points` (N + L, 3), None without any; records them."""
    meter.count()
    meter.record(forces.mean_distance_mm(samples.area))
    if not forces.weight.any():
        return None
    if pull is None:
        return Pairs(forces.offset, forces.normal, forces.weight, forces.tangential, NOISE_MM)
    offset = pull.seen_offsets(points[len(forces.weight) :])
    return Pairs(
        np.vstack([forces.offset, offset]),
        np.vstack([forces.normal, np.zeros_like(offset)]),
        np.concatenate([forces.weight, pull.person_weight(offset)]),
        np.concatenate([np.full(len(forces.weight), forces.tangential), np.ones(len(offset))]),
        NOISE_MM,
    )


def proportioned(
    scan: ScanSurface,
    samples: SurfaceSamples,
    reference: FloatArray,
    options: FitOptions,
    meter: Meter,
    landmarks: LandmarkPull | None = None,
) -> FloatArray:
    """Return control points (C, 3) whose face has the scan's proportions.

    `reference` (C, 3) are control points at rest, in the scan's frame and about of its size; a rigid motion
    and the `_modes` move them onto the scan and to the `landmarks`.
    """
    modes, precision = _modes(reference)
    steps = options.proportion_iterations

    def pairs(now: Alignment, points: FloatArray) -> Pairs | None:
        if meter.exhausted:
            return None
        progress = now.steps / max(steps - 1, 1)
        gate_mm = between((GATE_MM[0], LAST_GATE_MM), progress)
        gates = ForceGates(gate_mm, options.tangential, between(ROBUST_MM, progress))
        on_face = points[: len(samples.area)]
        forces = scan_forces(scan, on_face, samples.normals(on_face), gates, rim=samples.rim)
        return with_landmarks(forces, samples, landmarks, points, meter)

    matrix, weights = source(samples, samples.area * samples.rigidity, landmarks)
    rest, moves = matrix @ reference, np.stack([matrix @ modes[:, axis] for axis in range(3)], axis=1)
    found = align(rest, weights, pairs, steps=steps, modes=moves, precision=precision, scale_range=(1.0, 1.0))
    return found.pose.apply(reference + modes @ found.coefficients)


def _modes(reference: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return displacements (C, 3, M) of the control points by each mode, and the precision for `align`.

    Per spline of height: up, forward, and forward with the square of x in units of 60 mm (roundness).
    """
    centred = reference - reference.mean(0)
    height = (centred[:, 1] - centred[:, 1].min()) / max(np.ptp(centred[:, 1]), 1e-9)
    knots = np.concatenate([[0.0, 0.0], np.linspace(0, 1, KNOTS - 1), [1.0, 1.0]])
    spline = BSpline.design_matrix(np.clip(height, 0, 1 - 1e-9), knots, 2).toarray()
    modes = np.zeros((len(reference), 3, 3 * KNOTS))
    modes[:, 1, :KNOTS] = spline
    modes[:, 2, KNOTS : 2 * KNOTS] = spline
    modes[:, 2, 2 * KNOTS :] = 0.5 * (centred[:, 0, None] / 60) ** 2 * spline
    difference = np.diff(np.eye(KNOTS), axis=0)
    one = difference.T @ difference / STEP_MM**2 + np.eye(KNOTS) / LEVEL_MM**2
    return modes, block_diag(1.0, one, one, one)
