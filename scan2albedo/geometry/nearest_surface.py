"""Closest points on a scan for queries that move a little at a time: a k-d tree, then walks from there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import cKDTree

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class NearestHits:
    """`points` (N, 3), `face` (N,), `barycentric` (N, 3), `distance` (N,); `vertex` (N,) to walk on from."""

    points: FloatArray
    face: IntArray
    barycentric: FloatArray
    distance: FloatArray
    vertex: IntArray


class NearestSurface:
    """Closest points among the faces around the nearest vertex.

    The nearest vertex comes from a k-d tree or, given the answer for the points' last places, from a
    walk downhill over the edges. For meshes whose triangles are not much longer than the query
    distance the answer is the exact closest point but for rare ties (`ClosestPointQuery` is exact
    always, and ten times slower).

    Parameters
    ----------
    vertices : (V, 3) float64
    faces : (F, 3) int64
        Every vertex should be in a face; others are never returned.
    """

    def __init__(self, vertices: FloatArray, faces: IntArray) -> None:
        self._vertices = np.ascontiguousarray(vertices, np.float64)
        self._faces = np.ascontiguousarray(faces, np.int64)
        self._used = np.unique(self._faces)
        self._tree = cKDTree(self._vertices[self._used], balanced_tree=False, compact_nodes=False)
        order = np.argsort(self._faces.ravel(), kind="stable")
        self._ring = order // 3
        self._ring_start = np.zeros(len(self._vertices) + 1, np.int64)
        np.cumsum(np.bincount(self._faces.ravel(), minlength=len(self._vertices)), out=self._ring_start[1:])

    def query(self, points: FloatArray, start: IntArray | None = None) -> NearestHits:
        """Return the closest surface points of (N, 3) points.

        Parameters
        ----------
        points : (N, 3) float64
        start : (N,) int64, optional
            `vertex` of an earlier answer for nearby points; walks from there instead of searching.
        """
        targets = np.ascontiguousarray(points, np.float64)
        if start is None:
            vertex = self._used[self._tree.query(targets)[1]]
        else:
            vertex = np.array(start, np.int64)
        count = len(targets)
        closest, face = np.empty((count, 3)), np.empty(count, np.int64)
        weights, distance = np.empty((count, 3)), np.empty(count)
        _closest_around(
            targets,
            vertex,
            self._vertices,
            self._faces,
            self._ring,
            self._ring_start,
            closest,
            face,
            weights,
            distance,
        )
        return NearestHits(closest, face, weights, distance, vertex)


@njit(cache=True, nogil=True)
def _closest_around(points, vertex, xyz, faces, ring, ring_start, closest, face, weights, distance):  # type: ignore[no-untyped-def]
    """Walk each point's `vertex` downhill, then take the best of the triangles around it."""
    for i in range(len(points)):
        p = points[i]
        v = vertex[i]
        best = np.inf
        here = (xyz[v, 0] - p[0]) ** 2 + (xyz[v, 1] - p[1]) ** 2 + (xyz[v, 2] - p[2]) ** 2
        moved = True
        while moved:
            moved = False
            centre = v
            for r in range(ring_start[centre], ring_start[centre + 1]):
                for k in range(3):
                    u = faces[ring[r], k]
                    there = (xyz[u, 0] - p[0]) ** 2 + (xyz[u, 1] - p[1]) ** 2 + (xyz[u, 2] - p[2]) ** 2
                    if there < here:
                        here, v, moved = there, u, True
        vertex[i] = v
        for r in range(ring_start[v], ring_start[v + 1]):
            f = ring[r]
            a, b, c = xyz[faces[f, 0]], xyz[faces[f, 1]], xyz[faces[f, 2]]
            w0, w1, w2 = _triangle_weights(p, a, b, c)
            d = 0.0
            for k in range(3):
                d += (w0 * a[k] + w1 * b[k] + w2 * c[k] - p[k]) ** 2
            if d < best:
                best = d
                face[i] = f
                weights[i, 0], weights[i, 1], weights[i, 2] = w0, w1, w2
                for k in range(3):
                    closest[i, k] = w0 * a[k] + w1 * b[k] + w2 * c[k]
        distance[i] = np.sqrt(best)


@njit(cache=True, nogil=True)
def _triangle_weights(p, a, b, c):  # type: ignore[no-untyped-def]
    """Weights of the point of triangle abc nearest to p (Ericson, Real-Time Collision Detection, 5.1.5)."""
    d1 = d2 = d3 = d4 = d5 = d6 = 0.0
    for k in range(3):
        ab, ac = b[k] - a[k], c[k] - a[k]
        d1 += ab * (p[k] - a[k])
        d2 += ac * (p[k] - a[k])
        d3 += ab * (p[k] - b[k])
        d4 += ac * (p[k] - b[k])
        d5 += ab * (p[k] - c[k])
        d6 += ac * (p[k] - c[k])
    if d1 <= 0 and d2 <= 0:
        return 1.0, 0.0, 0.0
    if d3 >= 0 and d4 <= d3:
        return 0.0, 1.0, 0.0
    if d6 >= 0 and d5 <= d6:
        return 0.0, 0.0, 1.0
    vc = d1 * d4 - d3 * d2
    if vc <= 0 and d1 >= 0 and d3 <= 0:
        t = d1 / (d1 - d3)
        return 1 - t, t, 0.0
    vb = d5 * d2 - d1 * d6
    if vb <= 0 and d2 >= 0 and d6 <= 0:
        t = d2 / (d2 - d6)
        return 1 - t, 0.0, t
    va = d3 * d6 - d5 * d4
    if va <= 0 and d4 >= d3 and d5 >= d6:
        t = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return 0.0, 1 - t, t
    total = va + vb + vc
    if total <= 0:
        return 1.0, 0.0, 0.0
    return va / total, vb / total, vc / total
