"""Closest points on a triangle mesh, exactly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.geometry.mesh import face_normals
from scan2albedo.geometry.triangle_tree import TriangleTree

_FARTHEST = 1e100


@dataclass(frozen=True)
class ClosestHits:
    """Closest points of a surface: `points` (N, 3), `face` (N,), `barycentric` (N, 3), `distance` (N,)."""

    points: FloatArray
    face: IntArray
    barycentric: FloatArray
    distance: FloatArray


class ClosestPointQuery:
    """Closest-point queries against one mesh in any unit; raises ValueError when there is no face."""

    def __init__(self, vertices: ArrayLike, faces: ArrayLike) -> None:
        self._vertices = np.ascontiguousarray(vertices, np.float64)
        self._faces = checked_faces(faces)
        self._tree = TriangleTree(self._vertices, self._faces)

    def query(self, points: ArrayLike) -> ClosestHits:
        """Return the closest hits to points (N, 3), O(log F) each; raises ValueError for NaN or infinity."""
        return ClosestHits(*self._tree.query(checked_points(points)))

    def query_facing(
        self, points: ArrayLike, normals: ArrayLike, *, min_cosine: float = 0.3, neighbours: int = 32
    ) -> ClosestHits:
        """Return the closest surface point whose face looks the way of each point's normal.

        Where surfaces lie against each other (closed lips, lids) the closest point may be on the wrong one.
        Where the cosine of unit `normals` (N, 3) and the face's normal is below `min_cosine`, the nearest
        compatible face among those of the `neighbours` nearest face centres is taken; the closest point stays
        where none is compatible, or the normal is zero.
        """
        from scipy.spatial import cKDTree

        targets, facing = np.asarray(points, np.float64), np.asarray(normals, np.float64)
        hits, across = self.query(targets), face_normals(self._vertices, self._faces)
        agreement = np.einsum("ij,ij->i", across[hits.face], facing)
        wrong = np.flatnonzero((agreement < min_cosine) & (np.abs(facing).sum(1) > 0))
        if len(wrong) == 0:
            return hits
        tree = cKDTree(self._vertices[self._faces].mean(1))
        _, near = tree.query(targets[wrong], k=min(neighbours, len(self._faces)))
        near = near.reshape(len(wrong), -1)
        for row, candidates in zip(wrong.tolist(), near, strict=True):
            fit = candidates[across[candidates] @ facing[row] >= min_cosine]
            if len(fit):
                _place_on(hits, row, targets[row], self._vertices[self._faces[fit]], fit)
        return hits


def checked_points(points: ArrayLike) -> FloatArray:
    """Return points (N, 3) as float64; ValueError for NaN, infinity or squared distances that overflow."""
    targets = np.ascontiguousarray(points, np.float64)
    if bad := int((~(np.abs(targets) < _FARTHEST)).any(axis=-1).sum()):
        raise ValueError(
            f"{bad} of {len(targets)} points are NaN, infinite or beyond {_FARTHEST:g}; no surface point is "
            "closest to them"
        )
    return targets


def checked_faces(faces: ArrayLike) -> IntArray:
    """Return faces (F, 3) as contiguous int64. Raises ValueError when there is none."""
    index = np.ascontiguousarray(faces, np.int64)
    if len(index) == 0:
        raise ValueError("a surface without faces has no closest points")
    return index


def _place_on(hits: ClosestHits, row: int, point: FloatArray, triangles: FloatArray, faces: IntArray) -> None:
    """Overwrite one row of `hits` with the closest point on a few triangles (clamped barycentrics)."""
    weights = barycentric_coordinates(np.broadcast_to(point, (len(faces), 3)), triangles)
    candidates = np.einsum("nk,nkj->nj", weights, triangles)
    distance = np.linalg.norm(candidates - point, axis=1)
    best = int(np.argmin(distance))
    hits.points[row], hits.face[row] = candidates[best], faces[best]
    hits.barycentric[row], hits.distance[row] = weights[best], distance[best]


def barycentric_coordinates(points: FloatArray, triangles: FloatArray) -> FloatArray:
    """Return (N, 3) barycentric coordinates of points (N, 3) in the planes of triangles (N, 3, 3).

    A degenerate triangle gives all weight to its first corner.
    """
    e0, e1 = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    d = points - triangles[:, 0]
    a, b, c = (np.einsum("ij,ij->i", p, q) for p, q in ((e0, e0), (e0, e1), (e1, e1)))
    p, q = np.einsum("ij,ij->i", d, e0), np.einsum("ij,ij->i", d, e1)
    determinant = a * c - b * b
    good = determinant > 1e-14 * np.maximum(a, c) ** 2
    safe = np.where(good, determinant, 1.0)
    v, w = np.where(good, (c * p - b * q) / safe, 0.0), np.where(good, (a * q - b * p) / safe, 0.0)
    weights = np.clip(np.stack([1 - v - w, v, w], 1), 0, None)
    return weights / weights.sum(1, keepdims=True)
