"""Evenly spread, denoised samples of a surface, what every rigid search works on, and how noisy it is."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray, NDArray, dots, norms
from scan2albedo.geometry import mesh
from scan2albedo.geometry.mesh import neighbour_lists, normalized, vertex_normals
from scan2albedo.statistics.robust import normal_deviation

_MAX_RAW_SAMPLES = 400_000
_LEAST_AGREEMENT = 0.3


@dataclass(frozen=True)
class OrientedPoints:
    """Surface samples: `points` (N, 3), unit `normals` (N, 3), `areas` (N,) of the surface they stand for."""

    points: FloatArray
    normals: FloatArray
    areas: FloatArray

    def __len__(self) -> int:
        return len(self.points)

    @cached_property
    def tree(self) -> cKDTree:
        """The k-d tree over the points."""
        return cKDTree(self.points)

    def subset(self, index: IntArray) -> OrientedPoints:
        """Return the samples at `index`."""
        return OrientedPoints(self.points[index], self.normals[index], self.areas[index])

    def inside_out(self) -> OrientedPoints:
        """Return the samples with their normals turned over."""
        return OrientedPoints(self.points, -self.normals, self.areas)


def oriented_points(vertices: FloatArray, faces: IntArray, spacing: float) -> OrientedPoints:
    """Sample a mesh at about one point every `spacing`, averaged over cubes of that side.

    So neither the tessellation nor vertex noise matters: the normal of a cube is the sum of the area vectors
    in it. Cubes whose normals cancel are left out; samples are ordered by cube.
    """
    # Of millions of faces every so-manieth stands for its neighbours.
    read_stride = int(np.ceil(len(faces) / _MAX_RAW_SAMPLES)) or 1
    faces = faces[::read_stride]
    cross = mesh.face_cross_products(vertices, faces)
    area = norms(cross) / 2
    used = np.flatnonzero(area > 0)
    per_face = np.clip(np.ceil(2 * area[used] / spacing**2), 1, 256).astype(int)
    stride = int(np.ceil(per_face.sum() / _MAX_RAW_SAMPLES)) or 1
    used, per_face = used[::stride], per_face[::stride]
    owner = np.repeat(used, per_face)
    step = np.arange(len(owner)) - np.repeat(np.cumsum(per_face) - per_face, per_face)
    share = np.repeat(1 / per_face, per_face) * (stride * read_stride)
    # Points of an R2 sequence, step 0 the centroid.
    first, second = (2 / 3 + 0.7548776662466927 * step) % 1.0, (2 / 3 + 0.5698402909980532 * step) % 1.0
    fold = first + second > 1
    first, second = np.where(fold, 1 - first, first), np.where(fold, 1 - second, second)
    points = np.einsum("nk,nkd->nd", np.stack([1 - first - second, first, second], 1), vertices[faces[owner]])
    areas, vectors = area[owner] * share, cross[owner] * (share / 2)[:, None]
    if len(points) == 0:
        return OrientedPoints(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    cells = np.floor((points - points.min(0)) / spacing).astype(int)
    extent = cells.max(0) + 1
    key = (cells[:, 0] * extent[1] + cells[:, 1]) * extent[2] + cells[:, 2]
    _, cell = np.unique(key, return_inverse=True)
    total: NDArray = np.bincount(cell, areas)
    mean, normal = (
        np.stack([np.bincount(cell, values[:, axis]) for axis in range(3)], 1)
        for values in (points * areas[:, None], vectors)
    )
    length = norms(normal)
    kept = length > _LEAST_AGREEMENT * total
    return OrientedPoints(mean[kept] / total[kept, None], normal[kept] / length[kept, None], total[kept])


def anchors(samples: OrientedPoints, *, spacing: float, limit: int, reach: float) -> OrientedPoints:
    """Return at most `limit` well-spread samples at least `spacing` apart, farthest first.

    Their normals are the averages by area of those within `reach` around them.
    """
    chosen = farthest_points(samples.points, spacing, limit)
    around = samples.tree.query_ball_point(samples.points[chosen], reach)
    outward = np.array([(samples.normals[i] * samples.areas[i, None]).sum(0) for i in around])
    return OrientedPoints(samples.points[chosen], normalized(outward.reshape(-1, 3)), samples.areas[chosen])


def farthest_points(points: FloatArray, spacing: float, limit: int) -> IntArray:
    """Return indices of points at least `spacing` apart, farthest first, at most `limit` of them."""
    chosen, squared = [0], np.full(len(points), np.inf)
    while len(chosen) < min(limit, len(points)):
        squared = np.minimum(squared, cdist(points[chosen[-1:]], points, "sqeuclidean")[0])
        chosen.append(int(squared.argmax()))
        if squared[chosen[-1]] < spacing * spacing:
            return np.array(chosen[:-1])
    return np.array(chosen[: len(points)], int)


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
        height = dots(above, normals)
        degree = np.diff(begins)
        gap = np.where(degree >= 4, height / np.sqrt(1 + 1 / np.maximum(degree, 1)), np.nan)
        return cls(gap, mesh.vertex_areas(vertices, faces))

    def among(self, chosen: BoolArray) -> tuple[float, float]:
        """Return the noise's standard deviation among some vertices (V,), and the area of one of them.

        Robustly about the median, so that neither curvature nor creases count. No noise among few vertices.
        """
        chosen = chosen & np.isfinite(self.gap)
        if chosen.sum() < 20:
            return 0.0, 0.0
        gap = self.gap[chosen]
        return float(normal_deviation(gap - np.median(gap))), float(self.area[chosen].mean())


def above_neighbours(vertices: FloatArray, begins: IntArray, neighbours: IntArray) -> FloatArray:
    """Return (V, 3) offsets of the vertices from the mean of their neighbours (`neighbour_lists`)."""
    around = csr_array((np.ones(len(neighbours)), neighbours, begins), shape=(len(vertices),) * 2)
    return vertices - around @ vertices / np.maximum(np.diff(begins), 1)[:, None]
