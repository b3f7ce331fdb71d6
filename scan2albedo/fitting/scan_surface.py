"""The scan as the fit sees it: in the model's frame, cropped, thinned, with normals and borders."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.fitting.scan_smoothing import SurfaceAverages
from scan2albedo.geometry import mesh
from scan2albedo.geometry.closest_points import ClosestHits, NearestSurface
from scan2albedo.geometry.rigid import transform_points

WELD_STEP_MM, CELL = 1e-3, 1.25
"""Vertices that lie in one cell of this size, CELL per mm of smoothing, are made one."""
STRAY, TORN, MIN_COMPONENT = 5.0, 0.6, 0.005
"""Faces with a corner farther outside the box than STRAY times its sides are a scanner's error; a scan with a
greater part of its vertices on borders than TORN is torn; loose parts with a smaller share of the faces
float."""


@dataclass(frozen=True)
class ScanSurface:
    """Scan triangles near the model: vertices (V, 3) in the model's frame, mm, and `boundary` (V,) bool."""

    vertices: FloatArray
    faces: IntArray
    normals: FloatArray
    boundary: BoolArray

    @cached_property
    def nearest(self) -> NearestSurface:
        """The closest-point index of these triangles."""
        return NearestSurface(self.vertices, self.faces)

    @cached_property
    def edge_mm(self) -> float:
        """Median length of the edges."""
        return mesh.usual_edge(self.vertices, self.faces)

    def normals_at(self, hits: ClosestHits) -> FloatArray:
        """Return (N, 3) interpolated normals (not unit) at closest points."""
        return np.einsum("nk,nkj->nj", hits.barycentric, self.normals[self.faces[hits.face]])

    def on_boundary(self, hits: ClosestHits) -> BoolArray:
        """Return (N,) True where the closest point lies on the border of the scan or of a hole."""
        return np.where(self.boundary[self.faces[hits.face]], hits.barycentric, 0.0).sum(1) > 0.999

    def turned_outward(self, points: FloatArray, normals: FloatArray, reach_mm: float) -> ScanSurface:
        """Return the surface, reversed when most normals disagree with the model's `normals` at `points`."""
        hits = self.nearest.query(points)
        near = hits.distance < reach_mm
        agreement = np.einsum("ij,ij->i", self.normals_at(hits)[near], normals[near])
        if np.sum(agreement > 0) >= np.sum(agreement < 0):
            return self
        return ScanSurface(self.vertices, self.faces[:, ::-1].copy(), -self.normals, self.boundary)

    def moved(self, target_from_here: FloatArray) -> ScanSurface:
        """Return the surface in another frame (rigid (4, 4))."""
        vertices = transform_points(target_from_here, self.vertices)
        return ScanSurface(vertices, self.faces, self.normals @ target_from_here[:3, :3].T, self.boundary)


def scan_near_model(
    vertices: FloatArray,
    faces: IntArray,
    model_from_scan: FloatArray,
    low: FloatArray,
    high: FloatArray,
    smoothing_mm: float = 0.0,
) -> ScanSurface | None:
    """Return the scan's surface inside the box `low` ... `high` (3,) of the model's frame; None when empty.

    Vertices nearer to each other than the smoothing are joined; then noise is averaged and floaters are
    dropped. Faces with one corner inside stay, so that the cut makes no border near the model. A scan torn
    into shreds keeps its floaters and gets no border.
    """
    xyz = transform_points(model_from_scan, vertices)
    inside = np.all((xyz >= low) & (xyz <= high), axis=1)
    stray = np.any((xyz < low - STRAY * (high - low)) | (xyz > high + STRAY * (high - low)), axis=1)
    near = faces[inside[faces].any(1) & ~stray[faces].any(1)]
    if len(near) == 0:
        return None
    kept, index = mesh.without_unreferenced(xyz, near)
    thin = mesh.thinned(xyz[kept], index, max(CELL * smoothing_mm, WELD_STEP_MM))
    if len(thin.faces) == 0:
        return None
    torn = float(thin.boundary.mean()) > TORN
    faces = thin.faces
    if not torn:
        part = mesh.vertex_components(len(thin.vertices), faces)[faces[:, 0]]
        share = np.bincount(part) / len(part)
        faces = faces[share[part] >= min(MIN_COMPONENT, share.max())]
    kept, index = mesh.without_unreferenced(thin.vertices, faces)
    points, count = thin.vertices[kept], thin.count[kept]
    boundary = thin.boundary[kept] & (not torn)
    averages = SurfaceAverages(points, index, boundary, count)
    # Normals are taken over a wider surface than positions: noise turns them more.
    fair = averages.smoothed(2 * smoothing_mm)
    points = averages.smoothed(smoothing_mm, keep_curvature=True)
    return ScanSurface(points, index, mesh.vertex_normals(fair, index), boundary)
