"""The shape that a template is too coarse for: normals of the fitted surface and of the scan."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.fitting import FittedFace
from scan2albedo.geometry.closest_points import surface_query
from scan2albedo.geometry.mesh import (
    adjacency,
    boundary_vertex_mask,
    normalized,
    usual_edge,
    vertex_normals,
    without_unreferenced,
)
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.geometry.surface_noise import SurfaceNoise
from scan2albedo.geometry.tangents import in_tangent_space

REACH_MM = 4.0
"""What lies farther from a surface has its shape from elsewhere."""
LEAST_COSINE = 0.5
"""Surfaces face the same way above this cosine."""
FEWEST_PASSES, MOST_PASSES, NOISE_RAD = 2, 40, 0.07
"""Averages over neighbours: their noise falls with their number, and so with the square of the angle that
noise turns a face by over an edge; two suffice up to about this angle a pass."""
FADE_PASSES = 8
"""Averages over which the scan's own shape fades at its edges: about three edges of its faces wide."""
ON_EDGE = 1e-6
"""Share of a closest point's face that is not the surface's edge, below which it lies on that edge."""


class FineShape:
    """Normals of a fitted face in the model's frame: those of the scan where it has a surface.

    The scan's normals are the fitted surface's, to which what the scan differs by is added, averaged over
    neighbours. So noise averages out, and shape that the fit follows stays sharp. The difference fades at the
    scan's edges. Without a scan, or away from it, the fitted surface alone remains.
    """

    def __init__(self, fitted: FittedFace, scan: RawScan | None) -> None:
        self._fit = _Surface(fitted.vertices, fitted.faces, vertex_normals(fitted.vertices, fitted.faces))
        self._scan: _Surface | None = None
        if scan is not None:
            placed = transform_points(fitted.model_from_scan, scan.vertices)
            self._scan = self._scan_surface(placed, scan.faces)

    def _scan_surface(self, vertices: FloatArray, faces: IntArray) -> _Surface | None:
        """Return what lies at the fitted surface and faces its way, None when nothing does."""
        low, high = self._fit.vertices.min(0) - REACH_MM, self._fit.vertices.max(0) + REACH_MM
        boxed = np.flatnonzero(((vertices >= low) & (vertices <= high)).all(1))
        own, close = vertex_normals(vertices, faces), np.zeros(len(vertices), bool)
        base = np.zeros_like(own)
        base[boxed], close[boxed] = self._fit.normals_at(vertices[boxed])
        close &= np.einsum("ij,ij->i", own, base) > LEAST_COSINE
        kept = faces[close[faces].all(1)]
        if len(kept) == 0:
            return None
        used, faces = without_unreferenced(vertices, kept)
        vertices, base, differs = vertices[used], base[used], (own - base)[used]
        noise_rad = SurfaceNoise.of(vertices, faces).among(np.ones(len(vertices), bool))[0]
        noise_rad /= max(usual_edge(vertices, faces), 1e-9)
        passes = int(np.clip(round((noise_rad / NOISE_RAD) ** 2), FEWEST_PASSES, MOST_PASSES))
        around = adjacency(len(vertices), faces) + sparse.identity(len(vertices), format="csr")
        mean = sparse.diags(1 / np.asarray(around.sum(1)).ravel()) @ around
        for _ in range(passes):
            differs = mean @ differs
        inner = (~boundary_vertex_mask(len(vertices), faces)).astype(np.float64)
        share = inner
        for _ in range(FADE_PASSES):
            share = inner * (mean @ share)
        return _Surface(vertices, faces, normalized(base + share[:, None] * differs))

    def normals(self, points: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Return unit normals (N, 3) at points (N, 3), and whether (N,) there is a surface."""
        normal, known = self._fit.normals_at(points)
        if self._scan is not None:
            own, close = self._scan.normals_at(points, beyond_edges=False)
            normal, known = np.where(close[:, None], own, normal), known | close
        return normal, known


class _Surface:
    """A surface (V, 3), (F, 3) with normals (V, 3) of its own."""

    def __init__(self, vertices: FloatArray, faces: IntArray, normals: FloatArray) -> None:
        self.vertices, self._faces, self._normals = vertices, faces, normals
        self._query = surface_query(vertices, faces)
        self._inner = ~boundary_vertex_mask(len(vertices), faces)

    def normals_at(self, points: FloatArray, *, beyond_edges: bool = True) -> tuple[FloatArray, BoolArray]:
        """Return unit normals (N, 3) at the closest points, and whether they are within reach.

        Unless `beyond_edges`, points in a hole or beside the surface are not.
        """
        hits = self._query.query(points)
        corners = self._faces[hits.face]
        close = hits.distance <= REACH_MM
        if not beyond_edges:
            close &= np.einsum("nk,nk->n", hits.barycentric, self._inner[corners]) > ON_EDGE
        normal = np.einsum("nk,nkc->nc", hits.barycentric, self._normals[corners])
        return normalized(normal), close


def tangent_normals(
    fine: tuple[FloatArray, BoolArray], normals: FloatArray, tangents: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Return what `FineShape.normals` found in frames (N, 3), (N, 4), and whether (N,) it stands.

    It is flat, (0, 0, 1), where there is no surface. Normals that lean too far from the template are another
    part's, such as the other lip's: they do not stand.
    """
    found = in_tangent_space(fine[0], normals, tangents)
    found = np.where(fine[1][:, None], found, (0.0, 0.0, 1.0))
    return found, found[:, 2] >= LEAST_COSINE


def normal_bytes(normal: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Return normals (..., 3) in [-1, 1] as glTF's normal maps store them, 8 bits, linear.

    >>> normal_bytes(np.array([[0.0, -1.0, 1.0]]))
    array([[128,   0, 255]], dtype=uint8)
    """
    return np.round(127.5 * (np.clip(normal, -1, 1) + 1)).astype(np.uint8)
