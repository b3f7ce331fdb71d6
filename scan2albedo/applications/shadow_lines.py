"""Lines in a scan's unlit texture, where the light's outlines miss those of the texture.

On the face's chart each texel says which lamps reach it (`scan2albedo.albedo.texel_light`). Beyond it the
shape is the scan's own, coarse and rough: near outlines of the light only detail is kept, and what it lies on
is filled in from both sides, where these are alike.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, uniform_filter
from scipy.spatial import cKDTree

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.geometry.rasterization import filled_smoothly

_STEEP = 0.08
"""Change of log light in a mm of the surface from which there is an outline."""
_NEAR_MM = 3.0
"""Up to this distance from an outline colours are doubtful; from twice as much on not at all."""
_DETAIL_MM = 0.7
"""Standard deviation of the mean that detail is what is left of."""
_LEAST_KNOWN = 0.05
"""Part of what is around a texel that has to be known."""
_ALIKE, _UNLIKE = 0.12, 0.25
"""Deviation of log V around a texel up to which all of it is one material, and from which it is not."""
_DARK = 1e-4
"""Albedo below which no logarithm is taken."""


def outlines(vertices: FloatArray, faces: IntArray, log_light: FloatArray, points: FloatArray) -> FloatArray:
    """Return (N, 2) how near points are to outlines of log light (V, 3), 0 to 1, and their steps."""
    ends = np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    first, second = vertices[ends[:, 0]], vertices[ends[:, 1]]
    value = log_light.mean(-1)
    steep = np.abs(value[ends[:, 0]] - value[ends[:, 1]]) > _STEEP * np.linalg.norm(second - first, axis=1)
    found = np.zeros((len(points), 2))
    if not steep.any():
        return found
    low, high = value.copy(), value.copy()
    for _ in range(3):  # edges from one end of an outline's step to its middle
        for here, there in (ends.T, ends.T[::-1]):
            np.minimum.at(low, here, low[there])
            np.maximum.at(high, here, high[there])
    middle = (first[steep] + second[steep]) / 2
    distance, nearest = cKDTree(middle).query(points, distance_upper_bound=2 * _NEAR_MM)
    within = np.isfinite(distance)
    found[:, 0] = np.clip(2 - distance / _NEAR_MM, 0.0, 1.0)
    found[within, 1] = (high - low)[ends[steep, 0]][nearest[within]]
    return found


def without_lines(
    albedo: FloatArray, outlines: FloatArray, there: BoolArray, texels_per_mm: float
) -> NDArray[np.float32]:
    """Return an unlit texture (H, W, 3) whose colours go on across `outlines` (H, W, 2), see there.

    No colour changes by more than the light does there, for that is all a misplaced outline can do. Only
    texels that are `there` (H, W) count.
    """
    near, step = np.moveaxis(outlines, -1, 0)
    known = there & (near <= 0)
    log_albedo = np.log(np.maximum(albedo, _DARK)).astype(np.float32)
    if not known.any() or not (there & (near > 0)).any():
        return albedo.astype(np.float32)

    def blurred(values: NDArray[np.float32]) -> NDArray[np.float32]:
        sigma = _DETAIL_MM * texels_per_mm
        return gaussian_filter(values, (sigma, sigma, 0), mode="mirror")

    inside = there[..., None].astype(np.float32)
    mean = blurred(log_albedo * inside) / np.maximum(blurred(inside), 1e-6)
    base = blurred(filled_smoothly(log_albedo, known))
    detail = log_albedo - mean
    # Detail of more than four times the median is a remainder of an outline.
    usual = 4 * float(np.median(np.abs(detail[known])))
    # How alike what is known is 16 mm around each texel: not hair, or hair and skin.
    side, value = 2 * max(1, round(16 * texels_per_mm)) + 1, mean.max(-1)
    part, first, second = (
        uniform_filter(field, side, mode="mirror")
        for field in (known * 1.0, known * value.astype(np.float64), known * value.astype(np.float64) ** 2)
    )
    around, square = np.stack([first, second]) / np.maximum(part, 1e-6)
    deviation = np.sqrt(np.maximum(square - around**2, 0.0))
    alike = np.where(part > _LEAST_KNOWN, np.clip((_UNLIKE - deviation) / (_UNLIKE - _ALIKE), 0.0, 1.0), 0.0)
    share = (near * there * alike)[..., None]
    limit = step[..., None]
    wanted = mean + (base - mean).clip(-limit, limit) + detail.clip(-usual, usual)
    return np.exp((1 - share) * log_albedo + share * wanted).astype(np.float32)
