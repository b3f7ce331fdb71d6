"""Displayed values of pictures, and the light that they stand for."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scan2albedo.errors import ReflectanceError

FloatArray = NDArray[np.float64]


def picture_values(picture: NDArray[Any], name: str, saturation: float) -> FloatArray:
    """Return values (H, W, 3), white = 1, of floats or of integers of 8 or 16 bits.

    Raises
    ------
    ReflectanceError
        When floats reach twice the saturation, which is no picture with white = 1, or for another dtype.
    """
    array = np.asarray(picture)
    if array.dtype in (np.uint8, np.uint16):
        return np.asarray(array / float(np.iinfo(array.dtype).max))
    if not np.issubdtype(array.dtype, np.floating):
        raise ReflectanceError(f"{name} is {array.dtype}, expected floats with white = 1, uint8 or uint16")
    values = array.astype(np.float64)
    largest = float(np.max(values, where=np.isfinite(values), initial=0.0))
    if largest > 2 * saturation:
        raise ReflectanceError(
            f"{name} reaches {largest:.4g}, expected values with white = 1: divide by the largest value the "
            "camera can give, or set `saturation` in the options for pictures beyond white"
        )
    return values


def linear_values(values: FloatArray, gamma: float) -> FloatArray:
    """Return values^gamma, odd, so that noise around 0 keeps its mean."""
    return np.copysign(np.abs(values) ** gamma, values)
