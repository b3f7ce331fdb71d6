"""How noisy a surface is: how its vertices scatter about their neighbours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.geometry.mesh import neighbour_lists, vertex_areas, vertex_normals

_NORMAL_MAD = 1.4826
"""Standard deviation of a normal distribution, relative to its median absolute deviation."""


@dataclass(frozen=True)
class SurfaceNoise:
    """What every vertex says of the noise.

    `gap` (V,) is the height above the mean of the n neighbours, relative to that of noise of 1, sqrt(1 + 1 /
    n); nan where there are few. `area` (V,) is the vertex's part of the surface.
    """

    gap: FloatArray
    area: FloatArray

    @classmethod
    def of(cls, vertices: FloatArray, faces: IntArray) -> SurfaceNoise:
        """Measure a mesh (V, 3), (F, 3)."""
        begins, neighbours = neighbour_lists(len(vertices), faces)
        above, normals = above_neighbours(vertices, begins, neighbours), vertex_normals(vertices, faces)
        height = np.einsum("ij,ij->i", above, normals)
        degree = np.diff(begins)
        gap = np.where(degree >= 4, height / np.sqrt(1 + 1 / np.maximum(degree, 1)), np.nan)
        return cls(gap, vertex_areas(vertices, faces))

    def among(self, chosen: BoolArray) -> tuple[float, float]:
        """Return the noise's standard deviation among some vertices (V,), and the area of one of them.

        Robustly about the median, so that neither curvature nor creases count. No noise among few vertices.
        """
        chosen = chosen & np.isfinite(self.gap)
        if chosen.sum() < 20:
            return 0.0, 0.0
        gap = self.gap[chosen]
        return float(_NORMAL_MAD * np.median(np.abs(gap - np.median(gap)))), float(self.area[chosen].mean())


def above_neighbours(vertices: FloatArray, begins: IntArray, neighbours: IntArray) -> FloatArray:
    """Return (V, 3) offsets of the vertices from the mean of their neighbours (`neighbour_lists`)."""
    around = csr_array((np.ones(len(neighbours)), neighbours, begins), shape=(len(vertices),) * 2)
    return np.asarray(vertices - around @ vertices / np.maximum(np.diff(begins), 1)[:, None])
