"""Means of a photograph over the footprints of texels, in one compiled pass."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def mean_over_footprints(photograph, centre, footprint, taps):  # type: ignore[no-untyped-def]
    """Return (N, C) float32 means of bilinear samples spread evenly over each footprint.

    Parameters
    ----------
    photograph : (H, W, C) float32
        Continued beyond its border by the border's pixels.
    centre : (N, 2) float64
        Middle of each footprint in pixels, (0, 0) the middle of the first pixel.
    footprint : (N, 2, 2) float64
        Its two sides, as columns, in pixels.
    taps : int
        Samples along each side.
    """
    height, width, channels = photograph.shape
    mean = np.empty((len(centre), channels), np.float32)
    total = np.empty(channels)
    for n in range(len(centre)):
        total[:] = 0.0
        for i in range(taps):
            right = (i + 0.5) / taps - 0.5
            for j in range(taps):
                down = (j + 0.5) / taps - 0.5
                x = centre[n, 0] + right * footprint[n, 0, 0] + down * footprint[n, 0, 1]
                y = centre[n, 1] + right * footprint[n, 1, 0] + down * footprint[n, 1, 1]
                # Written so that NaN, too, ends inside.
                x = min(x, width - 1.0) if x > 0 else 0.0
                y = min(y, height - 1.0) if y > 0 else 0.0
                left, top = int(x), int(y)
                u, v = x - left, y - top
                beside, below = min(left + 1, width - 1), min(top + 1, height - 1)
                for c in range(channels):
                    upper = (1 - u) * photograph[top, left, c] + u * photograph[top, beside, c]
                    lower = (1 - u) * photograph[below, left, c] + u * photograph[below, beside, c]
                    total[c] += (1 - v) * upper + v * lower
        for c in range(channels):
            mean[n, c] = total[c] / (taps * taps)
    return mean
