"""Channels that a highlight clipped, rebuilt from those it did not."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from scan2albedo.albedo.inpainting import surroundings

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_RADIUS = 40 / 512
_ENOUGH = 64
"""Fewer sources than this do not make a regression."""
_POOLED = 0.1
"""All sources together count as much as this part of a window full of sources."""
_RIDGE = 2e-5
"""Variance of log albedo below which channels are taken to keep their ratio: what 8 bits leave unsure."""
_FLOOR = 1e-4
"""Albedo below this counts as this in logarithms."""


def restore_channels(albedo: FloatArray, lost: NDArray[np.bool_], source: BoolArray) -> FloatArray:
    """Return `albedo` with the lost channels of texels predicted from their surviving ones.

    The camera's channels clip one after another, on skin red long before blue. Around each texel (40 texels
    at 512) the log albedo of a lost channel c is regressed on that of the surviving ones s over the sources,

    log A_c = m_c + sum_s b_s (log A_s - m_s), b = (C_ss + r)^-1 (C_sc + r / |s|),

    with means m, covariances C and a small ridge r that draws towards constant ratios. Few pigments colour
    a face, so that one channel tells much of the others; this is what a guided filter [1]_ does. The clipped
    value itself, divided by the light, is the least a lost channel can be.

    Parameters
    ----------
    albedo : (H, W, 3) float64
    lost : (H, W, 3) bool
        Channels without a trustworthy value. Texels that lost all three are left as they are.
    source : (H, W) bool
        Texels to learn from.

    Returns
    -------
    (H, W, 3) float64; unchanged where nothing is lost, and everywhere when there are too few sources.

    Notes
    -----
    Sums over windows come from tables of running sums: the cost is linear in the texels of the bounding box.

    References
    ----------
    .. [1] K. He, J. Sun, X. Tang, "Guided image filtering", ECCV 2010.
    """
    touched = any_channel(lost)
    target, origin = touched & ~all_channels(lost), source & ~touched
    if not target.any() or int(origin.sum()) < _ENOUGH:
        return albedo
    radius = max(4, round(_RADIUS * max(target.shape)))
    window = surroundings(target, 4 * radius)
    if int(origin[window].sum()) < _ENOUGH:
        window = (slice(None), slice(None))
    result = albedo.copy()
    inside = target[window]
    field = np.log(np.maximum(albedo[window], _FLOOR))
    predicted = _predict(
        field,
        np.argwhere(inside),
        lost[window],
        origin[window],
        radius,
        _POOLED * (2 * radius + 1) ** 2,
        _RIDGE,
    )
    old = albedo[window][inside]
    result[window][inside] = np.where(lost[window][inside], np.maximum(np.exp(predicted), old), old)
    return result


def any_channel(image: BoolArray) -> BoolArray:
    """Return (H, W) where any of three channels holds (several times as fast as `image.any(-1)`)."""
    return image[..., 0] | image[..., 1] | image[..., 2]


def all_channels(image: BoolArray) -> BoolArray:
    """Return (H, W) where all three channels hold."""
    return image[..., 0] & image[..., 1] & image[..., 2]


@njit(cache=True, nogil=True)
def _predict(field, texels, lost, source, radius, pooled, ridge):  # type: ignore[no-untyped-def]
    """Return (T, 3) the regression's value of every channel at `texels` (T, 2)."""
    height, width = source.shape
    # Running sums of the number of sources, their x_c, and their products x_c x_d.
    sums = np.zeros((height + 1, width + 1, 13))
    for i in range(height):
        line = np.zeros(13)
        for j in range(width):
            if source[i, j]:
                line[0] += 1
                for c in range(3):
                    line[1 + c] += field[i, j, c]
                    for d in range(3):
                        line[4 + 3 * c + d] += field[i, j, c] * field[i, j, d]
            sums[i + 1, j + 1] = sums[i, j + 1] + line
    result = np.empty((len(texels), 3))
    overall = sums[height, width] * (pooled / max(sums[height, width, 0], 1.0))
    for t in range(len(texels)):
        row, column = texels[t]
        top, left = max(0, row - radius), max(0, column - radius)
        bottom, right = min(height, row + radius + 1), min(width, column + radius + 1)
        s = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left] + overall
        mean = s[1:4] / s[0]
        covariance = s[4:].copy().reshape(3, 3) / s[0] - np.outer(mean, mean)
        survivors = np.flatnonzero(~lost[row, column])
        count = len(survivors)
        for c in range(3):
            if count == 1:
                a = survivors[0]
                slope = (covariance[a, c] + ridge) / (covariance[a, a] + ridge)
                result[t, c] = mean[c] + slope * (field[row, column, a] - mean[a])
            else:
                a, b = survivors[0], survivors[1]
                aa, bb, ab = covariance[a, a] + ridge, covariance[b, b] + ridge, covariance[a, b]
                ac, bc = covariance[a, c] + 0.5 * ridge, covariance[b, c] + 0.5 * ridge
                scale = 1 / (aa * bb - ab * ab)
                u, v = field[row, column, a] - mean[a], field[row, column, b] - mean[b]
                result[t, c] = mean[c] + scale * ((bb * ac - ab * bc) * u + (aa * bc - ab * ac) * v)
    return result
