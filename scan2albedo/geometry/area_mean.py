"""Images made smaller: each pixel is the mean of the area that it covers."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scan2albedo.core.arrays import BoolArray, FloatArray


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
    """Return an image (H, W, C) whose pixels outside of `known` (H, W) are means of what lies around them.

    Each is taken, by bilinear interpolation, from the finest of images of half the size that knows something
    there (pull-push [1]_). O(H W). Nothing is changed where nothing is known.

    .. [1] S. Gortler, R. Grzeszczuk, R. Szeliski, M. Cohen, "The Lumigraph", SIGGRAPH 1996, section 4.
    """
    from skimage.transform import resize

    if known.all() or not known.any():
        return values
    half = -(-known.shape[0] // 2), -(-known.shape[1] // 2)
    part = area_mean(known, half)
    # Sums of what is known differ from 0 by rounding only where nothing is known.
    there = part > 1e-6
    mean = area_mean(values * known[..., None], half) / np.where(there, part, 1.0)[..., None]
    coarse = filled_smoothly(mean.astype(values.dtype), there)
    around = resize(coarse, known.shape, order=1, mode="edge", anti_aliasing=False)
    return np.where(known[..., None], values, around).astype(values.dtype, copy=False)
