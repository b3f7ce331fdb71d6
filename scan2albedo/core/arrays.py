"""Types of arrays in annotations, whose shapes stand in docstrings, and a smooth step."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

BoolArray = NDArray[np.bool_]
FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


def smoothstep(x: ArrayLike) -> FloatArray:
    """Return 3 x^2 - 2 x^3 of x clipped to [0, 1]."""
    t = np.clip(np.asarray(x, float), 0, 1)
    return np.asarray(t * t * (3 - 2 * t))
