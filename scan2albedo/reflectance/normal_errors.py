"""How far the normals of a mesh are off, from the samples themselves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from scan2albedo.core import Meter
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.reflectance.robust_fit import TILT_FREEDOM, Observations, ReflectanceFitOptions, fit_rows

_VERTICES = 1000
"""That the deviation is found from, evenly chosen."""
_BROAD = np.radians(10.0)
"""Deviation that is assumed while tilts are found for it."""
_LEAST, _MOST = np.radians(0.02), np.radians(20.0)
_ROUNDS = 30


def normal_sigma(
    data: Observations,
    spread: FloatArray | None,
    rows: IntArray,
    options: ReflectanceFitOptions,
    meter: Meter,
) -> FloatArray:
    """Return the standard deviation (V,) of the normals along each tangent, radians.

    Tilts t of some vertices, with variances C, are found under a broad prior. The deviation follows
    s^2 = a + b spread^2, a and b >= 0, with the `spread` (V,) of the triangles' normals around each vertex
    (radians; none is a alone), by maximum likelihood: scoring of t.t / 2 - C, with weights of Student's t.
    """
    given = options.normal_sigma_degrees
    count = data.observed.shape[1]
    if not isinstance(given, str):
        return np.full(count, np.radians(given))
    few = rows[:: max(1, len(rows) // _VERTICES)]
    part = replace(data.of_vertices(few), tilt_sigma=np.full(len(few), _BROAD))
    fitted = fit_rows(part, np.arange(len(few)), options, meter.untraced())
    meter.count()
    wide = np.zeros(count) if spread is None else np.minimum(spread, 1.0) ** 2
    terms = np.stack([np.ones(len(few)), wide[few]], 1)
    noise = fitted.tilt_variance * np.fmax(_misfit_square(fitted.misfit), 1.0)
    return np.sqrt(
        np.clip(np.stack([np.ones(count), wide], 1) @ _scored(fitted.tilt, noise, terms), _LEAST**2, _MOST**2)
    )


def _misfit_square(sums: FloatArray) -> FloatArray:
    return np.asarray(sums[:, 0] / np.maximum(sums[:, 1] - 8, 1.0))


def _scored(tilt: FloatArray, noise: FloatArray, terms: FloatArray) -> FloatArray:
    """Return (2,) a and b of the variances terms (N, 2) @ (a, b) of tilts (N, 2) with noise (N,)."""
    from scipy.optimize import nnls

    square = (tilt**2).sum(1)
    found = np.array([np.radians(1.0) ** 2, 0.0])
    for _ in range(_ROUNDS):
        total = np.maximum(terms @ found, _LEAST**2) + noise
        robust = (TILT_FREEDOM + 2) / (TILT_FREEDOM + square / total)
        before, found = found, nnls(terms / total[:, None], (robust * square / 2 - noise) / total)[0]
        if np.abs(found - before).max() < 1e-3 * max(before.max(), 1e-12):
            break
    return np.asarray(found)
