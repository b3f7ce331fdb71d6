"""Search across an outline for where a mask ends."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scan2albedo.eyeglasses.on_face.mask_distance import MaskDistance

FloatArray = NDArray[np.float64]

_EDGE = 0.5
"""Distance from a mask's outermost pixels at which its edge lies."""


def search_edges(
    distance: MaskDistance, pixels: FloatArray, outward: FloatArray, reach_px: FloatArray, facing: float
) -> FloatArray:
    """Return (N,) signed ways along `outward` to the nearest place where the mask ends; NaN for none.

    Only ends that are left in the direction of `outward` count. Distances to the mask's nearest border would
    find the sides of a bar, never its end.

    Parameters
    ----------
    distance : MaskDistance
    pixels, outward : (N, 2) float64
        Places and unit vectors.
    reach_px : (N,) float64
        How far to look each way.
    facing : float
        Least cosine between `outward` and the mask's own outward direction where it ends.
    """
    result = np.full(len(pixels), np.nan)
    if not len(pixels):
        return result
    farthest = int(np.ceil(reach_px.max()))
    ways = np.arange(-farthest, farthest + 1.0)
    places = pixels[:, None] + ways[:, None] * outward[:, None]
    value, slope = distance.sample(places.reshape(-1, 2))
    value = value.reshape(len(pixels), -1)
    along = np.einsum("nki,ni->nk", slope.reshape(*value.shape, 2), outward)
    steep = along >= facing * np.linalg.norm(slope.reshape(*value.shape, 2), axis=2)
    with np.errstate(invalid="ignore"):
        leaves = (value[:, :-1] <= _EDGE) & (value[:, 1:] > _EDGE) & (steep[:, :-1] | steep[:, 1:])
    share = (_EDGE - value[:, :-1]) / np.where(leaves, value[:, 1:] - value[:, :-1], 1.0)
    way = np.where(leaves, ways[:-1] + share - _EDGE, np.inf)
    nearest = np.abs(way).argmin(1)
    found = way[np.arange(len(way)), nearest]
    within = np.abs(found) <= reach_px
    result[within] = found[within]
    return result
