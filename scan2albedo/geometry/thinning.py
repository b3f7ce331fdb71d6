"""Join the vertices of a mesh that is finer than is needed: one for each cell of a grid."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.geometry.mesh import edges_with_faces


@dataclass(frozen=True)
class ThinnedSurface:
    """A mesh of `faces` (F, 3) whose `vertices` (V, 3) are means of the `count` (V,) in one grid cell."""

    vertices: FloatArray
    faces: IntArray
    count: FloatArray

    @cached_property
    def boundary(self) -> BoolArray:
        """(V,) at edges of an odd number of faces: modulo 2 borders add up, which joining vertices keeps."""
        edges, uses = edges_with_faces(self.faces)
        mask = np.zeros(len(self.vertices), bool)
        mask[edges[uses % 2 == 1].ravel()] = True
        return mask


def thinned(vertices: FloatArray, faces: IntArray, cell: float) -> ThinnedSurface:
    """Join the vertices that lie in the same cell of a grid; this closes seams.

    `cell` is the side of the grid's cells in the mesh's unit, at least a millionth of the mesh's size.
    """
    # With more along a side cells could not be numbered in 64 bits.
    cell = max(cell, float(np.ptp(vertices, axis=0).max()) / 2**20)
    place = np.floor((vertices - vertices.min(0)) / cell + 0.5).astype(np.int64)
    span = place.max(0) + 1
    _, inverse = np.unique((place[:, 0] * span[1] + place[:, 1]) * span[2] + place[:, 2], return_inverse=True)
    cluster = inverse.ravel()
    count = np.bincount(cluster).astype(np.float64)
    means = np.stack([np.bincount(cluster, vertices[:, axis]) / count for axis in range(3)], 1)
    joined = cluster[faces]
    a, b, c = joined.T
    return ThinnedSurface(means, joined[(a != b) & (b != c) & (c != a)], count)
