"""The scan as the fit sees it: in the model's frame, cropped, welded, with normals and borders."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from scan2albedo.fitting.scan_smoothing import smoothed
from scan2albedo.geometry.closest_points import ClosestHits
from scan2albedo.geometry.mesh import (
    boundary_vertex_mask,
    vertex_components,
    vertex_normals,
    without_unreferenced,
)
from scan2albedo.geometry.nearest_surface import NearestHits, NearestSurface
from scan2albedo.geometry.rigid import transform_points

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

WELD_STEP_MM = 1e-3
NORMAL_SMOOTHING = 2.0
"""Normals are taken over this much wider a surface than positions: noise turns them more."""
MIN_COMPONENT = 0.005
"""Loose parts with a smaller share of the faces are floaters and pull at nothing."""


@dataclass(frozen=True)
class ScanSurface:
    """Scan triangles near the model.

    Parameters
    ----------
    vertices : (V, 3) float64
        Model frame, mm.
    faces : (F, 3) int64
    normals : (V, 3) float64
    boundary : (V,) bool
    """

    vertices: FloatArray
    faces: IntArray
    normals: FloatArray
    boundary: BoolArray

    @cached_property
    def nearest(self) -> NearestSurface:
        """The closest-point index of these triangles."""
        return NearestSurface(self.vertices, self.faces)

    def normals_at(self, hits: NearestHits | ClosestHits) -> FloatArray:
        """Return (N, 3) interpolated normals (not unit) at closest points."""
        return np.einsum("nk,nkj->nj", hits.barycentric, self.normals[self.faces[hits.face]])

    def on_boundary(self, hits: NearestHits | ClosestHits) -> BoolArray:
        """Return (N,) True where the closest point lies on the border of the scan or of a hole."""
        weight = np.where(self.boundary[self.faces[hits.face]], hits.barycentric, 0.0).sum(1)
        return weight > 0.999

    def turned_outward(self, points: FloatArray, normals: FloatArray, reach_mm: float) -> ScanSurface:
        """Return the surface looking the way of the model's `normals` at `points`, inside out if need be."""
        hits = self.nearest.query(points)
        near = hits.distance < reach_mm
        agreement = np.einsum("ij,ij->i", self.normals_at(hits)[near], normals[near])
        if np.sum(agreement > 0) >= np.sum(agreement < 0):
            return self
        return ScanSurface(self.vertices, self.faces[:, ::-1].copy(), -self.normals, self.boundary)

    def moved(self, target_from_here: FloatArray) -> ScanSurface:
        """Return the surface in another frame (rigid (4, 4))."""
        return ScanSurface(
            transform_points(target_from_here, self.vertices),
            self.faces,
            self.normals @ target_from_here[:3, :3].T,
            self.boundary,
        )


def scan_near_model(
    vertices: FloatArray,
    faces: IntArray,
    model_from_scan: FloatArray,
    low: FloatArray,
    high: FloatArray,
    smoothing_mm: float = 0.0,
) -> ScanSurface | None:
    """Return the scan's surface inside the box `low` ... `high` (3,) of the model's frame; None when empty.

    Seam vertices are welded, so that seams are no borders, and floaters dropped. Faces that reach out
    of the box stay when one corner is inside, so that the cut itself makes no border near the model.
    """
    xyz = transform_points(model_from_scan, vertices)
    inside = np.all((xyz >= low) & (xyz <= high), axis=1)
    near = faces[inside[faces].any(1)]
    if len(near) == 0:
        return None
    kept, index = without_unreferenced(xyz, near)
    welded, index = _welded(xyz[kept], index)
    label = vertex_components(len(welded), index)[index[:, 0]]
    share = np.bincount(label) / len(label)
    index = index[share[label] >= min(MIN_COMPONENT, share.max())]
    kept, index = without_unreferenced(welded, index)
    welded = welded[kept]
    boundary = boundary_vertex_mask(len(welded), index)
    fair = smoothed(welded, index, boundary, NORMAL_SMOOTHING * smoothing_mm)
    welded = smoothed(welded, index, boundary, smoothing_mm)
    return ScanSurface(welded, index, vertex_normals(fair, index), boundary)


def _welded(xyz: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray]:
    """Join vertices that round to the same cell; drop the faces that lose their area by it."""
    cell = np.round((xyz - xyz.min(0)) / WELD_STEP_MM).astype(np.int64)
    span = cell.max(0) + 1
    key = (cell[:, 0] * span[1] + cell[:, 1]) * span[2] + cell[:, 2]
    _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
    joined = inverse.ravel()[faces]
    distinct = (
        (joined[:, 0] != joined[:, 1]) & (joined[:, 1] != joined[:, 2]) & (joined[:, 2] != joined[:, 0])
    )
    return xyz[first], joined[distinct] if distinct.any() else joined
