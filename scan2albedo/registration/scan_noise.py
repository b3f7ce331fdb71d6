"""How noisy a scan's surface is: how its vertices scatter about their neighbours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.geometry.mesh import neighbour_lists, vertex_areas, vertex_normals

_FEWEST_NEIGHBOURS = 4
_FEWEST_VERTICES = 20
_NORMAL_MAD = 1.4826
"""Standard deviation of a normal distribution, relative to its median absolute deviation."""


@dataclass(frozen=True)
class SurfaceNoise:
    """What every vertex says of the noise.

    `gap_mm` (V,) is the height along the normal above the mean of the n neighbours, relative to that of
    noise of 1 mm, sqrt(1 + 1 / n); nan where there are few. `area_mm2` (V,) is the vertex's part of the
    surface.
    """

    gap_mm: FloatArray
    area_mm2: FloatArray

    @classmethod
    def of(cls, vertices: FloatArray, faces: IntArray) -> SurfaceNoise:
        """Measure a mesh (V, 3), (F, 3)."""
        begins, neighbours = neighbour_lists(len(vertices), faces)
        gap_mm = _gaps(vertices, vertex_normals(vertices, faces), begins, neighbours, _FEWEST_NEIGHBOURS)
        return cls(gap_mm, vertex_areas(vertices, faces))

    def among(self, chosen: BoolArray) -> tuple[float, float]:
        """Return the noise's standard deviation in mm among some vertices (V,), and the area of one in mm2.

        Robustly about the median, so that neither curvature nor creases count. No noise among few vertices.
        """
        chosen = chosen & np.isfinite(self.gap_mm)
        if chosen.sum() < _FEWEST_VERTICES:
            return 0.0, 0.0
        gap_mm = self.gap_mm[chosen]
        noise_mm = _NORMAL_MAD * np.median(np.abs(gap_mm - np.median(gap_mm)))
        return float(noise_mm), float(self.area_mm2[chosen].mean())


@njit(cache=True, nogil=True)
def _gaps(vertices, normals, begins, neighbours, fewest):  # type: ignore[no-untyped-def]
    gaps = np.full(len(vertices), np.nan)
    for v in range(len(vertices)):
        degree = begins[v + 1] - begins[v]
        if degree < fewest:
            continue
        along = 0.0
        for k in range(3):
            total = 0.0
            for n in neighbours[begins[v] : begins[v + 1]]:
                total += vertices[n, k]
            along += (vertices[v, k] - total / degree) * normals[v, k]
        gaps[v] = along / np.sqrt(1 + 1 / degree)
    return gaps
