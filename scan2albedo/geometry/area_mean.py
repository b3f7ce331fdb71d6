"""Images made smaller: each pixel is the mean of the area that it covers."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.geometry.rasterization import bilinear


def area_mean(values: ArrayLike, shape: tuple[int, int]) -> FloatArray:
    """Return an image (H, W) or (H, W, C) with `shape` pixels, at most as many as it has on either side.

    Pixels that an area covers in part count by that part, as `cv2.INTER_AREA` and scikit-image's
    `resize_local_mean` do it, but in O(H W): sums are differences of sums from the edge on.

    >>> area_mean(np.arange(6.0).reshape(2, 3), (1, 2)).tolist()
    [[1.8333333333333333, 3.1666666666666665]]
    """
    result = np.asarray(values, np.float64)
    size = result.shape[:2]
    for axis, count in enumerate(shape):
        lines = np.moveaxis(result, axis, 0)
        sums = np.concatenate([np.zeros_like(lines[:1]), np.cumsum(lines, axis=0)])
        edges = np.arange(count + 1) * size[axis] / count
        whole = np.minimum(edges.astype(np.int64), size[axis] - 1)
        part = (edges - whole).reshape(-1, *[1] * (lines.ndim - 1))
        result = np.moveaxis(np.diff(sums[whole] + part * lines[whole], axis=0), 0, axis)
    return np.asarray(result / (size[0] * size[1] / (shape[0] * shape[1])))


def filled_smoothly(values: NDArray[Any], known: BoolArray) -> NDArray[Any]:
    """Return an image (H, W, C) as `fill_smoothly` leaves it; `values` stay."""
    filled = values.copy()
    fill_smoothly(filled, known)
    return filled


def fill_smoothly(values: NDArray[Any], known: BoolArray) -> None:
    """Set the pixels of an image (H, W, C) outside of `known` (H, W) to means of what lies around them.

    Each is taken, by bilinear interpolation, from the finest of images of half the size that knows something
    there (pull-push [1]_). O(H W), in bands of rows. Nothing is changed where nothing is known.

    .. [1] S. Gortler, R. Grzeszczuk, R. Szeliski, M. Cohen, "The Lumigraph", SIGGRAPH 1996, section 4.
    """
    if known.all() or not known.any():
        return
    height, width = known.shape
    half = np.array([-(-height // 2), -(-width // 2)])
    coarse, there = np.empty((*half, values.shape[2]), values.dtype), np.empty(half, bool)
    # A pixel of a half of odd height has parts of three rows, so that no rows begin a band.
    rows = max(2**18 // width, 1) * 2 if height % 2 == 0 else height
    for top in range(0, height, rows):
        band, small = np.s_[top : top + rows], np.s_[top // 2 : -(-min(top + rows, height) // 2)]
        shape = coarse[small].shape[:2]
        part = area_mean(known[band], shape)
        # Sums of what is known differ from 0 by rounding only where nothing is known.
        there[small] = part > 1e-6
        total = area_mean(values[band] * known[band, :, None], shape)
        coarse[small] = total / np.where(there[small], part, 1.0)[..., None]
    fill_smoothly(coarse, there)
    for top in range(0, height, rows):
        row, column = np.nonzero(~known[top : top + rows])
        row += top
        middle = np.stack([column, row], axis=1) + 0.5
        values[row, column] = bilinear(coarse, middle * (half / known.shape)[::-1] - 0.5)
