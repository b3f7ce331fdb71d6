"""Closest points on a scan for queries that move a little at a time: a k-d tree, then walks from there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.geometry.closest_points import (
    ClosestHits,
    ClosestPointQuery,
    checked_faces,
    checked_points,
)
from scan2albedo.geometry.mesh import face_lists, neighbour_lists
from scan2albedo.geometry.triangle_tree import weights_nearest_origin


@dataclass(frozen=True)
class NearestHits(ClosestHits):
    """Closest points of a surface, and the nearest `vertex` (N,) to walk on from."""

    vertex: IntArray


MAX_EXACT_FACES = 100_000
"""Denser surfaces have triangles so small that the faces around the nearest vertex are as good."""


def surface_query(vertices: FloatArray, faces: IntArray) -> ClosestPointQuery | NearestSurface:
    """Return the exact query of a surface of few faces, the quick one of a surface of many."""
    exact = len(faces) <= MAX_EXACT_FACES
    return ClosestPointQuery(vertices, faces) if exact else NearestSurface(vertices, faces)


class NearestSurface:
    """Closest points among the faces around the nearest vertex; vertices without a face are never returned.

    The nearest vertex comes from a k-d tree or, given the answer for the points' last places, from a walk
    downhill over the edges. For meshes whose triangles are not much longer than the query distance the answer
    is the exact closest point but for rare ties (`ClosestPointQuery` is always exact, but several times
    slower).
    """

    def __init__(self, vertices: FloatArray, faces: IntArray) -> None:
        self._vertices = np.ascontiguousarray(vertices, np.float64)
        self._faces = checked_faces(faces)
        used = np.zeros(len(self._vertices), bool)
        used[self._faces.ravel()] = True
        self._used = np.flatnonzero(used)
        self._tree = cKDTree(self._vertices[self._used], balanced_tree=False)
        self._ring_start, self._ring = face_lists(len(self._vertices), self._faces)
        self._near_start, self._near = neighbour_lists(len(self._vertices), self._faces)

    @property
    def arrays(self) -> tuple[NDArray[np.generic], ...]:
        """Return the kernels' arguments: vertices (V, 3), faces (F, 3), ring, ring_start, near, near_start.

        The faces around vertex v are ring[ring_start[v] : ring_start[v + 1]], its neighbours
        near[near_start[v] : near_start[v + 1]].
        """
        return self._vertices, self._faces, self._ring, self._ring_start, self._near, self._near_start

    def nearest_vertices(self, points: FloatArray) -> IntArray:
        """Return the index (N,) of the vertex nearest to each of the (N, 3) points."""
        return np.asarray(self._used[self._tree.query(points)[1]], np.int64)

    def query(self, points: FloatArray, start: IntArray | None = None) -> NearestHits:
        """Return the closest surface points of points (N, 3).

        The search walks from `start` (N,), the `vertex` of an earlier answer for nearby points, if given.
        """
        targets = checked_points(points)
        vertex = self.nearest_vertices(targets) if start is None else np.array(start, np.int64)
        count = len(targets)
        closest, face = np.empty((count, 3)), np.empty(count, np.int64)
        weights, distance = np.empty((count, 3)), np.empty(count)
        _closest_around(
            targets,
            vertex,
            *self.arrays,
            closest,
            face,
            weights,
            distance,
        )
        return NearestHits(closest, face, weights, distance, vertex)


@njit(cache=True, nogil=True)
def _closest_around(p, vertex, xyz, faces, ring, ring_start, near, near_start, closest, face, weights, gap):  # type: ignore[no-untyped-def]
    """Walk each point p's `vertex` downhill, then take the best of the triangles around it."""
    for i in range(len(p)):
        x, y, z = p[i, 0], p[i, 1], p[i, 2]
        v = walk_downhill(x, y, z, vertex[i], xyz, near, near_start)
        vertex[i] = v
        best, f, w0, w1, w2, px, py, pz = nearest_around(x, y, z, v, xyz, faces, ring, ring_start)
        face[i] = f
        weights[i, 0], weights[i, 1], weights[i, 2] = w0, w1, w2
        closest[i, 0], closest[i, 1], closest[i, 2] = x + px, y + py, z + pz
        gap[i] = np.sqrt(best)


@njit(cache=True, nogil=True)
def nearest_around(x, y, z, v, xyz, faces, ring, ring_start):  # type: ignore[no-untyped-def]
    """Return squared distance, triangle, corner weights and offset of the closest point around vertex v."""
    best, nearest = np.inf, 0
    k0, k1, k2 = 1.0, 0.0, 0.0
    ox, oy, oz = 0.0, 0.0, 0.0
    for r in range(ring_start[v], ring_start[v + 1]):
        f = ring[r]
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, az = xyz[a, 0] - x, xyz[a, 1] - y, xyz[a, 2] - z
        bx, by, bz = xyz[b, 0] - x, xyz[b, 1] - y, xyz[b, 2] - z
        cx, cy, cz = xyz[c, 0] - x, xyz[c, 1] - y, xyz[c, 2] - z
        w0, w1, w2 = weights_nearest_origin(ax, ay, az, bx, by, bz, cx, cy, cz)
        px = w0 * ax + w1 * bx + w2 * cx
        py = w0 * ay + w1 * by + w2 * cy
        pz = w0 * az + w1 * bz + w2 * cz
        d = px * px + py * py + pz * pz
        if d < best:
            best, nearest = d, f
            k0, k1, k2 = w0, w1, w2
            ox, oy, oz = px, py, pz
    return best, nearest, k0, k1, k2, ox, oy, oz


@njit(cache=True, nogil=True)
def walk_downhill(x, y, z, v, xyz, near, near_start):  # type: ignore[no-untyped-def]
    """Return the vertex from which no neighbour is nearer to (x, y, z), starting at v."""
    here = (xyz[v, 0] - x) ** 2 + (xyz[v, 1] - y) ** 2 + (xyz[v, 2] - z) ** 2
    moved = True
    while moved:
        moved, centre = False, v
        for r in range(near_start[centre], near_start[centre + 1]):
            u = near[r]
            there = (xyz[u, 0] - x) ** 2 + (xyz[u, 1] - y) ** 2 + (xyz[u, 2] - z) ** 2
            if there < here:
                here, v, moved = there, u, True
    return v
