"""How one surface lies on another, place by place: a turn and a scale that carry displacements across."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from scan2albedo.geometry.mesh import face_areas, face_cross_products, vertex_areas
from scan2albedo.geometry.operators import laplacian

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_LEAST_AREA = 1e-4
"""Faces smaller than this part of the mean tell no frame."""


def local_similarities(
    source: FloatArray, target: FloatArray, faces: IntArray, reach_mm: float
) -> FloatArray:
    """Return (V, 3, 3) the turn times scale that maps `source`'s surroundings of each vertex to `target`'s.

    Each triangle gives the linear map of its two edges and of its normal, which is as long as the root of the
    edges' cross product [1]_. The maps, weighted by area, are smoothed over `reach_mm` by
    (M + reach^2 / 2 L) X = M X_0, M the vertices' areas and L the cotangent Laplacian; of what comes out the
    nearest similarity is kept.

    Parameters
    ----------
    source, target : (V, 3) float64
        The same mesh twice.
    faces : (F, 3) int64
    reach_mm : float

    References
    ----------
    .. [1] R. W. Sumner, J. Popovic, "Deformation transfer for triangle meshes", SIGGRAPH 2004, section 3.
    """
    area = face_areas(source, faces)
    whole = (area > _LEAST_AREA * area.mean()) & (face_areas(target, faces) > _LEAST_AREA * area.mean())
    used, weight = faces[whole], area[whole] / 3
    maps = _frames(target, used) @ np.linalg.inv(_frames(source, used))
    total = np.zeros((len(source), 9))
    rows = (weight[:, None, None] * maps).reshape(-1, 9)
    for corner in range(3):
        for column in range(9):
            total[:, column] += np.bincount(used[:, corner], rows[:, column], minlength=len(source))
    mass = np.maximum(vertex_areas(source, used), 1e-6 * float(area.mean()))
    system = sparse.diags(mass) + 0.5 * reach_mm**2 * laplacian(source, used)
    return _nearest_similarity(splu(system.tocsc()).solve(total).reshape(-1, 3, 3))


def _frames(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Return (F, 3, 3) whose columns are two edges and the normal at the root of their cross product."""
    corners, cross = vertices[faces], face_cross_products(vertices, faces)
    normal = cross / np.sqrt(np.linalg.norm(cross, axis=1, keepdims=True))
    return np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], normal], 2)


def _nearest_similarity(maps: FloatArray) -> FloatArray:
    u, stretch, vt = np.linalg.svd(maps)
    upright = np.where(np.linalg.det(u @ vt) < 0, -1.0, 1.0)
    u[:, :, 2] *= upright[:, None]
    scale = np.cbrt(np.prod(np.maximum(stretch, 1e-9), axis=1))
    return scale[:, None, None] * (u @ vt)
