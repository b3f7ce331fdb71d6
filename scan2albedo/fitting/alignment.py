"""Before anything bends: pose and size over the rigid regions, then the face's proportions.

Closest points alone let the sheet slide along a face whose eyes, nose and mouth stand at other heights.
"""

from collections.abc import Callable

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

NOISE_MM = 1.5
"""Standard deviation of the distance between the scan and a model in the person's shape."""
SIZE_SD = 0.012
"""Of the logarithm of the size about the registration's, which the rigid regions alone hardly show."""
KNOTS = 5
"""Quadratic B-splines over the height of the face."""
LEVEL_MM = 13.0
"""Standard deviation of a coefficient."""
STEP_MM = 1.3
"""Standard deviation of the difference between neighbouring coefficients."""


def aligned(
    scan: ScanSurface,
    samples: SurfaceSamples,
    control_points: FloatArray,
    weight: FloatArray,
    gates: Callable[[int], ForceGates],
    precision: FloatArray,
    *,
    steps: int,
    meter: Meter,
    modes: FloatArray | None = None,
    landmarks: LandmarkPull | None = None,
    rim: FloatArray | None = None,
    scale_range: tuple[float, float] = (1.0, 1.0),
) -> Alignment:
    """Return how `align` moves control points (C, 3) with modes (C, 3, M) onto the scan and to landmarks.

    `weight` (N,) is that of the samples, `gates` those of each step; see `scan_forces` for the `rim`.
    """
    forces: ScanForces | None = None
    matrix, weights = samples.matrix, weight
    if landmarks is not None:
        matrix = sparse.vstack([matrix, landmarks.matrix]).tocsr()
        weights = np.concatenate([weight, np.ones(len(landmarks.targets))])

    def pairs(now: Alignment, points: FloatArray) -> Pairs | None:
        nonlocal forces
        if now.steps and meter.exhausted:
            return None
        on_face = points[: len(weight)]
        start = forces if rim is None else None
        forces = scan_forces(scan, on_face, samples.normals(on_face), gates(now.steps), start, rim=rim)
        meter.count()
        meter.record(forces.mean_distance_mm(samples.area))
        if not forces.weight.any():
            return None
        along = np.full(len(weight), forces.tangential)
        found = Pairs(forces.offset, forces.normal, forces.weight, along, NOISE_MM)
        if landmarks is None:
            return found
        offset = landmarks.seen_offsets(points[len(weight) :])
        return Pairs(
            np.vstack([found.offset, offset]),
            np.vstack([found.normal, np.zeros_like(offset)]),
            np.concatenate([found.trust, landmarks.person_weight(offset)]),
            np.concatenate([along, np.ones(len(offset))]),
            NOISE_MM,
        )

    moves = None if modes is None else np.stack([matrix @ modes[:, axis] for axis in range(3)], axis=1)
    return align(
        matrix @ control_points,
        weights,
        pairs,
        steps=steps,
        modes=moves,
        precision=precision,
        scale_range=scale_range,
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
    and modes of proportion move them onto the scan and to the `landmarks`.
    """
    # Per spline of height: up, forward, and forward with the square of x in units of 60 mm (roundness).
    centred = reference - reference.mean(0)
    height = (centred[:, 1] - centred[:, 1].min()) / max(np.ptp(centred[:, 1]), 1e-9)
    knots = np.concatenate([[0.0, 0.0], np.linspace(0, 1, KNOTS - 1), [1.0, 1.0]])
    spline = BSpline.design_matrix(np.clip(height, 0, 1 - 1e-9), knots, 2).toarray()
    modes = np.zeros((len(reference), 3, 3 * KNOTS))
    modes[:, 1, :KNOTS] = spline
    modes[:, 2, KNOTS : 2 * KNOTS] = spline
    modes[:, 2, 2 * KNOTS :] = (centred[:, 0, None] / 60) ** 2 / 2 * spline
    difference = np.diff(np.eye(KNOTS), axis=0)
    one = difference.T @ difference / STEP_MM**2 + np.eye(KNOTS) / LEVEL_MM**2
    steps = 0 if meter.exhausted else options.proportion_iterations

    def gates(step: int) -> ForceGates:
        progress = step / max(steps - 1, 1)
        gate_mm = between((GATE_MM[0], 6.0), progress)
        return ForceGates(gate_mm, options.tangential, between((3.0, 1.5), progress))

    precision = block_diag(1.0, one, one, one)
    found = aligned(
        scan,
        samples,
        reference,
        samples.area * samples.rigidity,
        gates,
        precision,
        steps=steps,
        meter=meter,
        modes=modes,
        landmarks=landmarks,
        rim=samples.rim,
    )
    return found.pose.apply(reference + modes @ found.coefficients)
