"""Where directions lie in an environment map, and the radiance there: places serve any map."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def map_places(directions: FloatArray) -> FloatArray:
    """Return (N, 2) places in [0, 1] of directions (N, 3) of any length but zero: column and row by size.

    Rows run from +y down to -y, columns by azimuth from -pi to pi, from +z toward +x.
    """
    return np.asarray(_places(np.ascontiguousarray(directions, np.float64)))


def radiance_at(environment: FloatArray, places: FloatArray) -> FloatArray:
    """Return (N, 3) radiance of a map (H, W, 3) at places (N, 2), bilinear; it is linear in the map."""
    return np.asarray(_radiance(np.ascontiguousarray(environment, np.float64), places))


@njit(cache=True, nogil=True)
def _places(directions):  # type: ignore[no-untyped-def]
    result = np.empty((directions.shape[0], 2))
    for i in range(directions.shape[0]):
        x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
        # The angle from +y by its tangent: a cosine near 1 does not tell it.
        result[i, 0] = np.arctan2(x, z) / (2 * np.pi) + 0.5
        result[i, 1] = np.arctan2(np.sqrt(x * x + z * z), y) / np.pi
    return result


@njit(cache=True, nogil=True)
def _radiance(environment, places):  # type: ignore[no-untyped-def]
    height, width = environment.shape[:2]
    result = np.empty((places.shape[0], 3))
    for i in range(places.shape[0]):
        column = places[i, 0] * width - 0.5
        row = min(max(places[i, 1] * height - 0.5, 0.0), height - 1.0)
        left, top = int(np.floor(column)), int(np.floor(row))
        across, down = column - left, row - top
        below, right = min(top + 1, height - 1), (left + 1) % width
        left %= width
        for c in range(3):
            upper = (1 - across) * environment[top, left, c] + across * environment[top, right, c]
            lower = (1 - across) * environment[below, left, c] + across * environment[below, right, c]
            result[i, c] = (1 - down) * upper + down * lower
    return result
