"""Fit the face's proportions before anything bends: symmetric stretches along its height.

Where a person's eyes, nose and mouth stand at other heights than the model's, closest points alone let the
sheet slide along the face. A few numbers that keep the face's symmetry and its features whole are found
first; the bending starts from there.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from scan2albedo.core import Meter
from scan2albedo.fitting.forces import ForceGates, scan_forces
from scan2albedo.fitting.options import FitOptions, between
from scan2albedo.fitting.samples import SurfaceSamples
from scan2albedo.fitting.scan_surface import ScanSurface

FloatArray = NDArray[np.float64]

KNOTS = 5
"""Quadratic B-splines over the height of the face."""
HALF_WIDTH_MM = 60.0
LEVEL_MM = 13.0
STEP_MM = 1.3
"""Standard deviations of a coefficient, and of the difference between neighbouring ones."""
NOISE_MM = 1.5
INDEPENDENT_SAMPLES = 300
"""Neighbouring residuals err alike, so they weigh against the prior like this many."""
LAST_GATE_MM = 6.0
ROBUST_MM = (3.0, 1.5)


def proportioned(
    scan: ScanSurface, samples: SurfaceSamples, reference: FloatArray, options: FitOptions, meter: Meter
) -> FloatArray:
    """Return control points whose face has the scan's proportions.

    Gauss-Newton on a rigid motion and three splines of height (`_modes`), point to plane with the gates and
    robust weights of the forces, against a Gaussian prior on the splines.

    Parameters
    ----------
    scan : ScanSurface
    samples : SurfaceSamples
    reference : (C, 3) float64
        Control points at rest, in the scan's frame and about of its size.
    options : FitOptions
        `proportion_iterations` steps are taken.
    meter : Meter
        One evaluation a step; rows in mm.
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
            between((options.gate_mm[0], LAST_GATE_MM), progress),
            options.min_normal_cosine,
            options.tangential,
            options.robust_scale,
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
        found = found + np.linalg.solve(system, across.T @ (weight * gap) - prior @ found)
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
