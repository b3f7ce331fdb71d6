"""Relief: what is left of slopes when the broad bulge of a head is taken out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def without_quadratic_trend(values: FloatArray, position: FloatArray, weights: FloatArray) -> FloatArray:
    """Return values (N,) or (N, K) minus their weighted least-squares quadratic in position (N, 2).

    Positions should be of the order of 1.
    """
    x, y = position.T
    basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], 1)
    weighted = basis * weights[:, None]
    ridge = 1e-9 * (weights.sum() + 1e-300) * np.eye(6)
    return values - basis @ np.linalg.solve(weighted.T @ basis + ridge, weighted.T @ values)


def correlation(a: FloatArray, b: FloatArray, weights: FloatArray) -> float:
    """Return sum w a b / sqrt(sum w a^2 sum w b^2), 0 when either vanishes.

    >>> correlation(np.array([1.0, -1.0]), np.array([3.0, -3.0]), np.ones(2))
    1.0
    """
    norm = float(np.sqrt((weights @ (a * a)) * (weights @ (b * b))))
    return float(weights @ (a * b)) / norm if norm > 0 else 0.0
