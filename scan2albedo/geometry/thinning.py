"""Join the vertices of a mesh that is finer than is needed: one for each cell of a grid."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray

_MOST_CELLS = 2**20
"""Along a side of the grid."""


@dataclass(frozen=True)
class ThinnedSurface:
    """A triangle mesh whose vertices in one grid cell were joined.

    `vertices` (V, 3) are means of the `count` (V,) vertices joined; `faces` (F, 3) had corners in three
    cells.
    """

    vertices: FloatArray
    faces: IntArray
    count: FloatArray

    @cached_property
    def boundary(self) -> BoolArray:
        """(V,) on the border of the surface, which joining neither opens nor moves by more than a cell."""
        return _on_odd_edge(len(self.vertices), self.faces)


def thinned(vertices: FloatArray, faces: IntArray, cell: float) -> ThinnedSurface:
    """Join the vertices that lie in the same cell of a grid; this closes seams.

    `cell` is the side of the grid's cells in the mesh's unit, at least a millionth of the mesh's size.
    """
    # Beyond that cells could not be numbered in 64 bits.
    cell = max(cell, float(np.ptp(vertices, axis=0).max()) / _MOST_CELLS)
    place = np.floor((vertices - vertices.min(0)) / cell + 0.5).astype(np.int64)
    span = place.max(0) + 1
    key = (place[:, 0] * span[1] + place[:, 1]) * span[2] + place[:, 2]
    _, inverse = np.unique(key, return_inverse=True)
    cluster = inverse.ravel()
    count = np.bincount(cluster).astype(np.float64)
    means = np.stack([np.bincount(cluster, vertices[:, axis]) / count for axis in range(3)], 1)
    joined = cluster[faces]
    a, b, c = joined.T
    distinct = joined[(a != b) & (b != c) & (c != a)]
    return ThinnedSurface(means, distinct, count)


def _on_odd_edge(count: int, faces: IntArray) -> BoolArray:
    """Return (V,) True at edges of an odd number of faces.

    A border is the sum of all faces' borders modulo 2, and joining vertices keeps that sum: faces that then
    coincide make no border where there was none.
    """
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    keys = np.sort(edges[:, 0] * np.int64(count) + edges[:, 1])
    starts = np.flatnonzero(np.diff(keys, prepend=-1))
    odd = keys[starts[np.diff(starts, append=len(keys)) % 2 == 1]]
    mask = np.zeros(count, bool)
    mask[odd // count] = True
    mask[odd % count] = True
    return mask
