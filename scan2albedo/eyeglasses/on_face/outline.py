"""The outline of a mesh in a picture: which surface points make the border of its mask."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.geometry.rasterization import nearest_faces

_AROUND = 3
"""Pixels each way whose uncovered ones show where outside is."""
_SPREAD = np.array([0.63131, 0.52854])
"""Numbers whose sums, differences and multiples have fractional parts that are spread evenly; found by trying
thousands for ten ways that an outline may run."""


@dataclass(frozen=True)
class Coverage:
    """What a mesh covers of a picture, inside a window around it."""

    face: NDArray[np.int32]
    """(h, w) foremost face at each pixel's centre, -1 for none."""
    corner: tuple[int, int]
    """Row and column of the window's first pixel in the picture."""


@dataclass(frozen=True)
class Outline:
    """Pixels of a mask that touch the outside, and the surface points at their centres."""

    pixels: IntArray
    """(N, 2) column, row."""
    face: IntArray
    """(N,)"""
    barycentric: FloatArray
    """(N, 3) on the surface, perspective taken out."""
    outward: FloatArray
    """(N, 2) unit vectors in the picture, away from the mask."""

    def thinned(self, stride: int) -> Outline:
        """Return one in `stride` of the pixels, spread evenly by a low-discrepancy sum of column and row."""
        if stride == 1:
            return self
        kept = self.pixels @ _SPREAD % 1.0 < 1.0 / stride
        return Outline(self.pixels[kept], self.face[kept], self.barycentric[kept], self.outward[kept])


def cover(pixels: FloatArray, depth: FloatArray, faces: IntArray, shape: tuple[int, int]) -> Coverage:
    """Return the pixels that a mesh covers of a picture (H, W), by a perspective z-buffer.

    `pixels` (V, 2) are column and row, `depth` (V,) distances from the camera's plane; faces with vertices
    behind the camera (NaN) are left out.
    """
    seen = pixels[np.isfinite(pixels).all(1)]
    limits = np.array([shape[1], shape[0]])
    if len(seen) == 0:
        return Coverage(np.full((0, 0), -1, np.int32), (0, 0))
    # A pixel more on each side: borders need the uncovered neighbour.
    low = np.clip(np.floor(seen.min(0)) - 1, 0, limits).astype(np.int64)
    high = np.clip(np.ceil(seen.max(0)) + 2, 0, limits).astype(np.int64)
    size = np.maximum(high - low, 0)
    nearness = 1 / np.where(depth > 0, depth, np.nan)
    face = nearest_faces(pixels - low, nearness, faces, (int(size[1]), int(size[0])))
    return Coverage(face, (int(low[1]), int(low[0])))


def trace_outline(
    coverage: Coverage, pixels: FloatArray, depth: FloatArray, faces: IntArray, shape: tuple[int, int]
) -> Outline:
    """Return the covered pixels with an uncovered 4-neighbour; the picture's border is no outline."""
    row, column, outward = _border(coverage.face, coverage.corner[0], coverage.corner[1], *shape)
    length = np.linalg.norm(outward, axis=1)
    kept = length > 0
    place, face, share = _points_at(row[kept], column[kept], coverage, pixels, depth, faces)
    return Outline(place, face, share, outward[kept] / length[kept, None])


def covered_points(
    coverage: Coverage, pixels: FloatArray, depth: FloatArray, faces: IntArray
) -> tuple[IntArray, IntArray, FloatArray]:
    """Return all covered pixels (N, 2), their faces (N,) and the surface points' barycentric (N, 3)."""
    row, column = np.nonzero(coverage.face >= 0)
    return _points_at(row, column, coverage, pixels, depth, faces)


def _points_at(
    row: IntArray,
    column: IntArray,
    coverage: Coverage,
    pixels: FloatArray,
    depth: FloatArray,
    faces: IntArray,
) -> tuple[IntArray, IntArray, FloatArray]:
    face = coverage.face[row, column].astype(np.int64)
    place = np.stack([column + coverage.corner[1], row + coverage.corner[0]], 1)
    corners = faces[face]
    a, b, c = (pixels[corners[:, i]] - place for i in range(3))
    flat = np.stack([_area(b, c), _area(c, a), _area(a, b)], 1) / depth[corners]
    return place, face, flat / flat.sum(1, keepdims=True)


def _area(a: FloatArray, b: FloatArray) -> FloatArray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


@njit(cache=True, nogil=True)
def _border(face, first_row, first_column, height, width):  # type: ignore[no-untyped-def]
    """Return rows, columns (N,) in the window, and sums of directions to uncovered pixels (N, 2)."""
    rows, columns = face.shape
    found = 0
    place = np.empty((rows * columns, 2), np.int64)
    outward = np.empty((rows * columns, 2))
    for row in range(rows):
        for column in range(columns):
            if face[row, column] < 0:
                continue
            open_side = False
            for dr, dc in ((-1, 0), (1, 0), (0, -1), (0, 1)):
                r, c = row + dr, column + dc
                inside = 0 <= r + first_row < height and 0 <= c + first_column < width
                if inside and (not (0 <= r < rows and 0 <= c < columns) or face[r, c] < 0):
                    open_side = True
            if not open_side:
                continue
            x, y = 0.0, 0.0
            for dr in range(-_AROUND, _AROUND + 1):
                for dc in range(-_AROUND, _AROUND + 1):
                    r, c = row + dr, column + dc
                    inside = 0 <= r + first_row < height and 0 <= c + first_column < width
                    if inside and (not (0 <= r < rows and 0 <= c < columns) or face[r, c] < 0):
                        x += dc
                        y += dr
            place[found, 0], place[found, 1] = row, column
            outward[found, 0], outward[found, 1] = x, y
            found += 1
    return place[:found, 0], place[:found, 1], outward[:found]
