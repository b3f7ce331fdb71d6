"""Sparse operators on a triangle mesh: Laplacians and the energies they make."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from scan2albedo.geometry.loop_subdivision import refine
from scan2albedo.geometry.mesh import boundary_vertex_mask, vertex_areas

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

MAX_COTANGENT = 5.0
"""Cotangents are clipped to [0, MAX_COTANGENT], so slivers (angles below 11 degrees) stay harmless."""


def corner_cotangents(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Return (F, 3) cotangents of the corner angles, clipped to [0, MAX_COTANGENT].

    A clipped cotangent keeps every edge weight non-negative, so the Laplacian is an M-matrix whatever
    the triangles; a zero-area face gets MAX_COTANGENT or 0.
    """
    corners = vertices[faces]
    u = corners[:, [1, 2, 0]] - corners
    v = corners[:, [2, 0, 1]] - corners
    sine = np.linalg.norm(np.cross(u, v), axis=2)
    cosine = np.einsum("fij,fij->fi", u, v)
    longest = np.maximum(np.einsum("fij,fij->fi", u, u), np.einsum("fij,fij->fi", v, v))
    return np.clip(cosine / np.maximum(sine, 1e-12 * longest + 1e-300), 0.0, MAX_COTANGENT)


def laplacian(
    vertices: FloatArray, faces: IntArray, face_weight: FloatArray | None = None
) -> sparse.csr_matrix:
    """Return the symmetric positive semi-definite (V, V) cotangent Laplacian L.

    u^T L u = sum over faces of w_f times the integral of |grad u|^2 (up to clipping): the membrane
    energy of a displacement u for the face stiffness w.

    Parameters
    ----------
    vertices : (V, 3) float64
    faces : (F, 3) int64
    face_weight : (F,) float64, optional
        Non-negative; 1 when omitted.

    References
    ----------
    .. [1] U. Pinkall, K. Polthier, "Computing Discrete Minimal Surfaces and Their Conjugates", 1993.
    """
    weights = 0.5 * corner_cotangents(vertices, faces)
    if face_weight is not None:
        weights = weights * face_weight[:, None]
    start, end = faces[:, [1, 2, 0]].ravel(), faces[:, [2, 0, 1]].ravel()
    shape = (len(vertices), len(vertices))
    directed = sparse.csr_matrix((weights.ravel(), (start, end)), shape=shape)
    symmetric = directed + directed.T
    return (sparse.diags(np.asarray(symmetric.sum(1)).ravel()) - symmetric).tocsr()


def bending(
    vertices: FloatArray, faces: IntArray, face_weight: FloatArray | None = None
) -> sparse.csr_matrix:
    """Return the (V, V) bending matrix B = L diag(w / a) L with L the Laplacian and a the vertex areas.

    u^T B u is the integral of w (Laplacian u)^2, the thin-plate energy of a displacement u. A vertex
    takes the least weight of its faces, so that a face of weight 0 is a cut that may open; rim vertices
    take 0 (the plate's free edge).
    """
    plain = laplacian(vertices, faces)
    area = vertex_areas(vertices, faces)
    floor = 1e-6 * max(float(area.mean()), 1e-300)
    weight = np.where(boundary_vertex_mask(len(vertices), faces), 0.0, 1.0)
    if face_weight is not None:
        weight = weight * vertex_minimum(len(vertices), faces, face_weight)
    return (plain @ sparse.diags(weight / np.maximum(area, floor)) @ plain).tocsr()


def vertex_minimum(vertex_count: int, faces: IntArray, face_value: FloatArray) -> FloatArray:
    """Return (V,) least of the values (F,) of the faces around each vertex; zero where there is none."""
    least = np.full(vertex_count, np.inf)
    np.minimum.at(least, faces.ravel(), np.repeat(face_value, 3))
    return np.where(np.isfinite(least), least, 0.0)


def vertex_average(vertex_count: int, faces: IntArray, face_value: FloatArray) -> FloatArray:
    """Return (V,) means of the values (F,) of the faces around each vertex; zero where there is none."""
    total = np.bincount(faces.ravel(), np.repeat(face_value, 3), minlength=vertex_count)
    count = np.bincount(faces.ravel(), minlength=vertex_count)
    return total / np.maximum(count, 1)


def linear_refinement(vertex_count: int, faces: IntArray, levels: int) -> sparse.csr_matrix:
    """Return the (V, C) matrix that interpolates linearly at the vertices of `levels` Loop refinements.

    The vertices are numbered as in `LoopSubdivision`; a flip-free chart stays flip-free under it.
    """
    matrix = sparse.identity(vertex_count, format="csr")
    current = np.asarray(faces, np.int64)
    for _ in range(levels):
        _, finer = refine(matrix.shape[0], current)
        count = matrix.shape[0]
        ends = np.full((finer.max() + 1 - count, 2), -1, np.int64)
        for corner, (start, end) in enumerate(((0, 1), (1, 2), (2, 0))):
            middle = finer[3::4][:, corner]
            ends[middle - count] = current[:, [start, end]]
        rows = np.repeat(np.arange(len(ends)), 2)
        halves = sparse.csr_matrix((np.full(len(rows), 0.5), (rows, ends.ravel())), shape=(len(ends), count))
        matrix = sparse.vstack([sparse.identity(count), halves]).tocsr() @ matrix
        current = finer
    return matrix
