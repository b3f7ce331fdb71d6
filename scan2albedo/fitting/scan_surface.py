"""The scan as the fit sees it: in the model's frame, cropped, thinned, with normals and borders."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray, dots
from scan2albedo.geometry import mesh
from scan2albedo.geometry.closest_points import ClosestHits, NearestSurface
from scan2albedo.geometry.oriented_points import above_neighbours
from scan2albedo.geometry.rigid import transform_points

WELD_STEP_MM = 1e-3
"""Vertices that lie in one cell of this size are made one."""
CELL = 1.25
"""Size of these cells per mm of smoothing."""
STRAY = 5.0
"""Faces with a corner farther outside the box than so many times its sides are a scanner's error."""
TORN = 0.6
"""A scan with a greater part of its vertices on borders is torn."""
MIN_COMPONENT = 0.005
"""Loose parts with a smaller share of the faces float."""

SPREAD_PER_PASS = 0.43
"""Variance along each axis that one average over a vertex and its neighbours adds, per edge length^2."""
REACH = 0.6
"""Standard deviation of the neighbours' weight over distance, per scale (or usual edge, if longer).

Without it a vertex whose neighbours are 8 mm away would be averaged with them as one 0.5 mm away is.
"""
_NO_SHARE = 1e-9
"""Sum of the shares below which nothing weighs in a vertex's mean."""


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
        return mesh.median_edge(self.vertices, self.faces)

    def normals_at(self, hits: ClosestHits) -> FloatArray:
        """Return (N, 3) interpolated normals (not unit) at closest points."""
        return hits.interpolated(self.normals, self.faces)

    def on_boundary(self, hits: ClosestHits) -> BoolArray:
        """Return (N,) True where the closest point lies on the border of the scan or of a hole."""
        return np.where(self.boundary[self.faces[hits.face]], hits.barycentric, 0.0).sum(1) > 0.999

    def turned_outward(self, points: FloatArray, normals: FloatArray, reach_mm: float) -> ScanSurface:
        """Return the surface, reversed when most normals disagree with the model's `normals` at `points`."""
        hits = self.nearest.query(points)
        near = hits.distance < reach_mm
        agreement = dots(self.normals_at(hits)[near], normals[near])
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
    surface = points, index, boundary, count.astype(float), mesh.neighbour_lists(len(points), index)
    # Normals are taken over a wider surface than positions: noise turns them more.
    normals = mesh.vertex_normals(smoothed(*surface, 2 * smoothing_mm), index)
    return ScanSurface(smoothed(*surface, smoothing_mm, keep_curvature=True), index, normals, boundary)


def smoothed(
    vertices: FloatArray,
    faces: IntArray,
    boundary: BoolArray,
    count: FloatArray,
    joined: tuple[IntArray, IntArray],
    scale_mm: float,
    *,
    keep_curvature: bool = False,
) -> FloatArray:
    """Return vertices (V, 3), but those on the `boundary` (V,), averaged over about `scale_mm` of surface.

    That is a standard deviation; the number of averages follows from the length of the edges, 40 at most.
    Every vertex is in a face and `joined` to its `neighbour_lists`; one that is the mean of `count` (V,)
    measurements has that weight. Spikes move to the mean of their neighbours. With `keep_curvature`, the
    difference that averages made is averaged as well and added back ("twicing", J. W. Tukey, "Exploratory
    Data Analysis", 1977, section 16).
    """
    edge_mm = mesh.median_edge(vertices, faces)
    passes = min(int(scale_mm**2 / (SPREAD_PER_PASS * max(edge_mm, 1e-9) ** 2) + 0.5), 40)
    if passes == 0:
        return vertices
    begins, neighbours = joined
    gap = mesh.lengths(above_neighbours(vertices, begins, neighbours))
    around = np.maximum.reduceat(gap[neighbours], begins[:-1])
    # Six times farther from the neighbours' mean than the median, and than any of them.
    spike = (gap > 6 * np.median(gap)) & (gap > around)
    weight, one = np.where(spike, 0.0, count), np.repeat(np.arange(len(vertices)), np.diff(begins))
    apart = mesh.lengths(vertices[neighbours] - vertices[one]) / (REACH * max(scale_mm, edge_mm))
    shares = np.where(spike[one], 1.0, np.exp(-0.5 * apart**2)) * weight[neighbours]
    total = weight + np.bincount(one, shares, len(vertices))
    # Means over each vertex and its neighbours; the border stays, and so does what has no weight around it.
    still = boundary | (total < _NO_SHARE)
    scale = np.where(still, 0.0, 1 / np.where(still, 1.0, total))
    means = sparse.csr_matrix((shares * scale[one], neighbours, begins), (len(vertices),) * 2)
    means += sparse.diags(np.where(still, 1.0, weight * scale))
    points = vertices
    for _ in range(passes):
        points = means @ points
    if not keep_curvature:
        return points
    taken = vertices - points
    for _ in range(passes):
        taken = means @ taken
    return points + taken
