"""Closest points on a triangle mesh: exactly, or quickly for queries that move a little at a time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from scan2albedo.core.arrays import ArrayLike, FloatArray, IntArray, NDArray, dots, norms, triangle_sides
from scan2albedo.core.compiled import compiled, triple
from scan2albedo.geometry.mesh import RayHits, face_lists, face_normals, neighbour_lists, vertex_mask
from scan2albedo.geometry.rigid import dot, minus

_FARTHEST = 1e100
MAX_EXACT_FACES = 100_000
"""Denser surfaces have triangles so small that the faces around the nearest vertex are as good."""


@dataclass(frozen=True)
class ClosestHits(RayHits):
    """Closest points of a surface: as of a ray that hits it, and the `points` (N, 3) themselves."""

    points: FloatArray

    def interpolated(self, values: NDArray, faces: IntArray) -> FloatArray:
        """Return values (V, ...) of the vertices of faces (F, 3) at the hits, (N, ...)."""
        return np.einsum("nk,nk...->n...", self.barycentric, values[faces[self.face]])


class ClosestPointQuery:
    """Closest-point queries against one mesh in any unit; raises ValueError when there is no face."""

    def __init__(self, vertices: ArrayLike, faces: ArrayLike) -> None:
        import igl

        self._vertices = np.ascontiguousarray(vertices, float)
        self._faces = checked_faces(faces)
        self._tree = igl.AABB()
        self._tree.init(self._vertices, self._faces)

    def query(self, points: ArrayLike) -> ClosestHits:
        """Return the closest hits to points (N, 3), O(log F) each; raises ValueError for NaN or infinity."""
        targets = checked_points(points)
        squared, face, closest = self._tree.squared_distance(self._vertices, self._faces, targets)
        weights = barycentric_coordinates(closest, self._vertices[self._faces[face]])
        return ClosestHits(face, weights, np.sqrt(squared), closest)

    def query_facing(self, points: ArrayLike, normals: ArrayLike) -> ClosestHits:
        """Return the closest surface point whose face looks the way of each point's normal.

        Where the cosine of unit `normals` (N, 3) and the closest face's normal is below 0.3 (closed lips),
        the nearest compatible face of the 32 nearest is taken, if any.
        """
        min_cosine = 0.3
        targets, facing = np.asarray(points, float), np.asarray(normals, float)
        hits, across = self.query(targets), face_normals(self._vertices, self._faces)
        agreement = dots(across[hits.face], facing)
        wrong = np.flatnonzero((agreement < min_cosine) & (np.abs(facing).sum(1) > 0))
        if len(wrong) == 0:
            return hits
        tree = cKDTree(self._vertices[self._faces].mean(1))
        _, near = tree.query(targets[wrong], k=min(32, len(self._faces)))
        near = near.reshape(len(wrong), -1)
        for row, candidates in zip(wrong.tolist(), near, strict=True):
            fit = candidates[across[candidates] @ facing[row] >= min_cosine]
            if len(fit):
                triangles = self._vertices[self._faces[fit]]
                weights = barycentric_coordinates(np.broadcast_to(targets[row], (len(fit), 3)), triangles)
                places = np.einsum("nk,nkj->nj", weights, triangles)
                distance = norms(places - targets[row])
                best = int(np.argmin(distance))
                hits.points[row], hits.face[row] = places[best], fit[best]
                hits.barycentric[row], hits.distance[row] = weights[best], distance[best]
        return hits


def checked_points(points: ArrayLike) -> FloatArray:
    """Return points (N, 3) as float64; ValueError for NaN, infinity or squared distances that overflow."""
    targets = np.ascontiguousarray(points, float)
    if bad := int((~(np.abs(targets) < _FARTHEST)).any(axis=-1).sum()):
        said = f"{bad} of {len(targets)} points are NaN, infinite or beyond {_FARTHEST:g}"
        raise ValueError(f"{said}; no surface point is closest to them")
    return targets


def checked_faces(faces: ArrayLike) -> IntArray:
    """Return faces (F, 3) as contiguous int64. Raises ValueError when there is none."""
    index = np.ascontiguousarray(faces, int)
    if len(index) == 0:
        raise ValueError("a surface without faces has no closest points")
    return index


def barycentric_coordinates(points: FloatArray, triangles: FloatArray) -> FloatArray:
    """Return (N, 3) barycentric coordinates of points (N, 3) in the planes of triangles (N, 3, 3).

    A degenerate triangle gives all weight to its first corner.
    """
    e0, e1 = triangle_sides(triangles)
    d = points - triangles[:, 0]
    a, b, c = (dots(p, q) for p, q in ((e0, e0), (e0, e1), (e1, e1)))
    p, q = dots(d, e0), dots(d, e1)
    determinant = a * c - b * b
    good = determinant > 1e-14 * np.maximum(a, c) ** 2
    safe = np.where(good, determinant, 1.0)
    v, w = np.where(good, (c * p - b * q) / safe, 0.0), np.where(good, (a * q - b * p) / safe, 0.0)
    weights = np.clip(np.stack([1 - v - w, v, w], 1), 0, None)
    return weights / weights.sum(1, keepdims=True)


def surface_query(vertices: FloatArray, faces: IntArray) -> ClosestPointQuery | NearestSurface:
    """Return the exact query of a surface of few faces, the quick one of a surface of many."""
    exact = len(faces) <= MAX_EXACT_FACES
    return ClosestPointQuery(vertices, faces) if exact else NearestSurface(vertices, faces)


class NearestSurface:
    """Closest points among the faces around the nearest vertex; vertices without a face are never returned.

    For triangles not much longer than the distance the answer is the closest point but for rare ties
    (`ClosestPointQuery` is exact, but several times slower).
    """

    def __init__(self, vertices: FloatArray, faces: IntArray) -> None:
        self._vertices = np.ascontiguousarray(vertices, float)
        self._faces = checked_faces(faces)
        self._used = np.flatnonzero(vertex_mask(len(self._vertices), self._faces))
        self._tree = cKDTree(self._vertices[self._used], balanced_tree=False)
        self._ring_start, self._ring = face_lists(len(self._vertices), self._faces)
        self._near_start, self._near = neighbour_lists(len(self._vertices), self._faces)

    @property
    def arrays(self) -> tuple[NDArray, ...]:
        """Return the kernels' arguments: vertices (V, 3), faces (F, 3), ring, ring_start, near, near_start.

        The faces around vertex v are ring[ring_start[v] : ring_start[v + 1]], its neighbours
        near[near_start[v] : near_start[v + 1]].
        """
        return self._vertices, self._faces, self._ring, self._ring_start, self._near, self._near_start

    def nearest_vertices(self, points: FloatArray) -> IntArray:
        """Return the index (N,) of the vertex nearest to each of the (N, 3) points."""
        return np.asarray(self._used[self._tree.query(points)[1]], int)

    def query(self, points: FloatArray) -> ClosestHits:
        """Return the closest surface points of points (N, 3)."""
        targets = checked_points(points)
        count = len(targets)
        closest, face = np.empty((count, 3)), np.empty(count, int)
        weights, distance = np.empty((count, 3)), np.empty(count)
        nearest = self.nearest_vertices(targets), *self.arrays[:4]
        _closest_around(targets, *nearest, closest, face, weights, distance)
        return ClosestHits(face, weights, distance, closest)


@compiled
def _closest_around(p, vertex, xyz, faces, ring, ring_start, closest, face, weights, gap):  # type: ignore[no-untyped-def]
    """Take for each point p the best of the triangles around its nearest `vertex`."""
    for i in range(len(p)):
        point = triple(p, i)
        best, face[i], weights[i], offset = nearest_around(point, vertex[i], xyz, faces, ring, ring_start)
        for k in range(3):
            closest[i, k] = point[k] + offset[k]
        gap[i] = np.sqrt(best)


@compiled
def nearest_around(point, v, xyz, faces, ring, ring_start):  # type: ignore[no-untyped-def]
    """Return squared distance, triangle, corner weights and offset of the closest point around vertex v."""
    best = np.inf
    nearest = 0
    weights = (1.0, 0.0, 0.0)
    offset = (0.0, 0.0, 0.0)
    for r in range(ring_start[v], ring_start[v + 1]):
        i, j, k = triple(faces, ring[r])
        a, b, c = minus(triple(xyz, i), point), minus(triple(xyz, j), point), minus(triple(xyz, k), point)
        w = weights_nearest_origin(a, b, c)
        at = mixed(w, a, b, c)
        d = dot(at, at)
        if d < best:
            best, nearest, weights, offset = d, ring[r], w, at
    return best, nearest, weights, offset


@compiled
def mixed(w, a, b, c):  # type: ignore[no-untyped-def]
    """Return the sum of three vectors by weights (3,), inside other compiled functions."""
    return (
        w[0] * a[0] + w[1] * b[0] + w[2] * c[0],
        w[0] * a[1] + w[1] * b[1] + w[2] * c[1],
        w[0] * a[2] + w[1] * b[2] + w[2] * c[2],
    )


@compiled
def walk_downhill(point, v, xyz, near, near_start):  # type: ignore[no-untyped-def]
    """Return the vertex from which no neighbour is nearer to a point (3,), starting at v."""
    away = minus(triple(xyz, v), point)
    moved = True
    while moved:
        moved, centre = False, v
        for r in range(near_start[centre], near_start[centre + 1]):
            tried = minus(triple(xyz, near[r]), point)
            if dot(tried, tried) < dot(away, away):
                away, v, moved = tried, near[r], True
    return v


@compiled
def weights_nearest_origin(a, b, c):  # type: ignore[no-untyped-def]
    """Weights of the point of triangle abc nearest to the origin (Ericson, Real-Time Collision Detection)."""
    u, v = minus(b, a), minus(c, a)
    d1, d2 = -dot(u, a), -dot(v, a)
    if d1 <= 0 and d2 <= 0:
        return 1.0, 0.0, 0.0
    d3, d4 = -dot(u, b), -dot(v, b)
    if d3 >= 0 and d4 <= d3:
        return 0.0, 1.0, 0.0
    d5, d6 = -dot(u, c), -dot(v, c)
    if d6 >= 0 and d5 <= d6:
        return 0.0, 0.0, 1.0
    vc = d1 * d4 - d3 * d2
    if vc <= 0 and d1 >= 0 and d3 <= 0:
        t = d1 / max(d1 - d3, 1e-300)
        return 1 - t, t, 0.0
    vb = d5 * d2 - d1 * d6
    if vb <= 0 and d2 >= 0 and d6 <= 0:
        t = d2 / max(d2 - d6, 1e-300)
        return 1 - t, 0.0, t
    va = d3 * d6 - d5 * d4
    if va <= 0 and d4 >= d3 and d5 >= d6:
        t = (d4 - d3) / max((d4 - d3) + (d5 - d6), 1e-300)
        return 0.0, 1 - t, t
    total = va + vb + vc
    if total <= 0:
        return 1.0, 0.0, 0.0
    return va / total, vb / total, vc / total
