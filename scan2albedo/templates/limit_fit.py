"""A control mesh whose Loop limit surface passes near a dense mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.loop_subdivision import LoopSubdivision, SurfacePoints
from scan2albedo.geometry.mesh import adjacency, vertex_normals

NORMAL_WEIGHT_MM = 12.0
"""Length equivalent to a turn of the normal by one radian when edges are collapsed."""
LEVELS, ITERATIONS, SMOOTHNESS, MAX_TARGETS = 2, 4, 0.005, 30_000


@dataclass(frozen=True)
class ControlMesh:
    """`vertices` (C, 3) and `faces` (F, 3) of a Loop control mesh."""

    vertices: FloatArray
    faces: IntArray


def decimated(vertices: FloatArray, faces: IntArray, size: int) -> ControlMesh:
    """Return a mesh of about `size` vertices, denser where the surface bends; smaller ones stay as they are.

    Edges collapse shortest first, measured between (position, NORMAL_WEIGHT_MM times normal).
    """
    import igl

    if len(vertices) <= 1.2 * size:
        return ControlMesh(vertices, faces)
    lifted = np.hstack([vertices, NORMAL_WEIGHT_MM * vertex_normals(vertices, faces)])
    target = int(len(faces) * size / len(vertices))
    collapsed, index, _, _ = igl.decimate(
        np.asfortranarray(lifted), np.asfortranarray(faces.astype(np.int32)), target
    )
    return ControlMesh(np.ascontiguousarray(collapsed[:, :3]), np.asarray(index, np.int64))


def fit_limit_surface(start: ControlMesh, vertices: FloatArray, faces: IntArray) -> ControlMesh:
    """Move the control vertices of `start` until the limit surface passes near the dense mesh (K, 3), (F, 3).

    Alternates projection of the dense vertices x_i on the limit surface, A_i P, with

        min_P  sum_i |A_i P - x_i|^2 + s N / C |L (P - P_0)|^2,  L the graph Laplacian, s small.
    """
    count = len(start.vertices)
    subdivision = LoopSubdivision.of(count, start.faces, LEVELS)
    chosen = np.unique(np.linspace(0, len(vertices) - 1, min(len(vertices), MAX_TARGETS)).astype(int))
    targets, normals = vertices[chosen], vertex_normals(vertices, faces)[chosen]
    ring = adjacency(count, start.faces)
    valence = np.maximum(np.asarray(ring.sum(1)).ravel(), 1)
    smooth = sparse.identity(count) - sparse.diags(1 / valence) @ ring
    stiff = SMOOTHNESS * len(chosen) / count * (smooth.T @ smooth)
    control = start.vertices
    for _ in range(ITERATIONS):
        points = project(subdivision, control, targets, normals)
        rows = subdivision.points_matrix(points)
        system = (rows.T @ rows + stiff).tocsc()
        control = splu(system).solve(rows.T @ targets + stiff @ start.vertices)
    return ControlMesh(control, start.faces)


def project(
    subdivision: LoopSubdivision, control: FloatArray, points: FloatArray, normals: FloatArray
) -> SurfacePoints:
    """Return where on the control faces the limit surface comes closest to points (N, 3) with normals."""
    surface = subdivision.matrix @ control
    hits = ClosestPointQuery(surface, subdivision.faces).query_facing(points, normals)
    return subdivision.control_points(SurfacePoints(hits.face, hits.barycentric))
