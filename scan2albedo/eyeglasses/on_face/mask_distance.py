"""Distances of pixels from the border of a mask."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core.arrays import BoolArray, FloatArray

_MARGIN_PX = 96
"""How far around the mask distances are computed; points farther away are out of reach anyway."""
_EDGE = 0.5
"""Distance from a mask's outermost pixels at which its edge lies."""


@dataclass(frozen=True)
class MaskDistance:
    """Distance in pixels from a mask's outermost covered pixels: 0 there, positive outside."""

    field: NDArray[np.float32]
    """(h, w) of a window around the mask."""
    corner: tuple[int, int]
    """Column and row of the window's first pixel."""

    @classmethod
    def of(cls, mask: BoolArray) -> MaskDistance:
        """Return the distances of a mask (H, W) that has both covered and uncovered pixels."""
        import cv2

        rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
        top, left = max(0, rows[0] - _MARGIN_PX), max(0, columns[0] - _MARGIN_PX)
        window = mask[top : rows[-1] + _MARGIN_PX + 1, left : columns[-1] + _MARGIN_PX + 1]
        covered = np.ascontiguousarray(window, np.uint8)
        out = cv2.distanceTransform(1 - covered, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        inner = cv2.distanceTransform(covered, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        # Outside, a border pixel's neighbour is 1 away; inside, border pixels are 1 from the outside.
        field = np.where(covered > 0, 1 - inner, out)
        return cls(np.ascontiguousarray(field, np.float32), (int(left), int(top)))

    def sample(self, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return distances (N,) and slopes (N, 2) by column and row, bilinear; NaN outside the window."""
        height, width = self.field.shape
        place = pixels - np.array(self.corner)
        with np.errstate(invalid="ignore"):
            inside = ((place >= 0) & (place <= [width - 1, height - 1])).all(1)
        where = np.where(inside[:, None], place, 0.0)
        first = np.minimum(np.floor(where), [width - 2, height - 2]).astype(np.int64)
        x, y = (where - first).T
        column, row = first.T
        a, b = self.field[row, column], self.field[row, column + 1]
        c, d = self.field[row + 1, column], self.field[row + 1, column + 1]
        value = (1 - y) * ((1 - x) * a + x * b) + y * ((1 - x) * c + x * d)
        slope = np.stack([(1 - y) * (b - a) + y * (d - c), (1 - x) * (c - a) + x * (d - b)], 1)
        value, slope = value.astype(np.float64), slope.astype(np.float64)
        value[~inside], slope[~inside] = np.nan, np.nan
        return value, slope


def search_edges(
    distance: MaskDistance, pixels: FloatArray, outward: FloatArray, reach_px: FloatArray, facing: float
) -> FloatArray:
    """Return (N,) signed distances along `outward` (N, 2) from `pixels` to the mask's edge; NaN for none.

    The nearest edge within `reach_px` (N,) either way counts, among those where `outward` leaves the mask, at
    a cosine of `facing` or more to the mask's own outward direction. Distances to the mask's nearest border
    would find the sides of a bar, never its end.
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
