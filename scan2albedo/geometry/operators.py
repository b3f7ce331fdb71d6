"""Sparse operators on a triangle mesh: Laplacians, their energies, derivatives of normals."""

import numpy as np
from scipy import sparse

from scan2albedo.core.arrays import FloatArray, IntArray, dots, norms, row_sums
from scan2albedo.geometry import mesh
from scan2albedo.geometry.loop_subdivision import refine

MAX_COTANGENT = 5.0
"""Cotangents are clipped to [0, MAX_COTANGENT], so slivers (angles below 11 degrees) stay harmless."""


def laplacian(
    vertices: FloatArray, faces: IntArray, face_weight: FloatArray | None = None
) -> sparse.csr_matrix:
    """Return the symmetric positive semi-definite (V, V) cotangent Laplacian L [1]_.

    u^T L u = sum over faces of w_f times the integral of |grad u|^2 (up to clipping): the membrane energy of
    a displacement u for the face stiffness w (F,) >= 0, 1 when omitted.

    .. [1] U. Pinkall, K. Polthier, "Computing Discrete Minimal Surfaces and Their Conjugates", 1993.
    """
    # Clipped cotangents of the corners: every edge weight is non-negative, L an M-matrix.
    corners = vertices[faces]
    u, v = corners[:, [1, 2, 0]] - corners, corners[:, [2, 0, 1]] - corners
    sine = norms(np.cross(u, v))
    cosine = dots(u, v)
    longest = np.maximum(dots(u, u), dots(v, v))
    weights = np.clip(cosine / np.maximum(sine, 1e-12 * longest + 1e-300), 0.0, MAX_COTANGENT) / 2
    if face_weight is not None:
        weights = weights * face_weight[:, None]
    start, end = faces[:, [1, 2, 0]].ravel(), faces[:, [2, 0, 1]].ravel()
    directed = sparse.csr_matrix((weights.ravel(), (start, end)), shape=(len(vertices), len(vertices)))
    symmetric = directed + directed.T
    return (sparse.diags(row_sums(symmetric)) - symmetric).tocsr()


def bending(
    vertices: FloatArray, faces: IntArray, face_weight: FloatArray | None = None
) -> sparse.csr_matrix:
    """Return the (V, V) bending matrix B = L diag(w / a) L with L the Laplacian and a the vertex areas.

    u^T B u is the thin-plate energy of a displacement u. A vertex takes the least weight of its faces, rim
    vertices 0 (the plate's free edge).
    """
    plain = laplacian(vertices, faces)
    area = mesh.vertex_areas(vertices, faces)
    floor = 1e-6 * max(float(area.mean()), 1e-300)
    weight = np.where(mesh.boundary_vertex_mask(len(vertices), faces), 0.0, 1.0)
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
    return total / np.maximum(np.bincount(faces.ravel(), minlength=vertex_count), 1)


def linear_refinement(vertex_count: int, faces: IntArray, levels: int) -> sparse.csr_matrix:
    """Return the (V, C) matrix that interpolates linearly at the vertices of `levels` Loop refinements.

    The vertices are numbered as in `LoopSubdivision`; a flip-free chart stays flip-free under it.
    """
    matrix = sparse.identity(vertex_count, format="csr")
    current = np.asarray(faces, int)
    for _ in range(levels):
        count, (ends, _) = matrix.shape[0], mesh.edges_with_faces(current)  # in the order of `refine`
        rows = np.repeat(np.arange(len(ends)), 2)
        halves = sparse.csr_matrix((np.full(len(rows), 0.5), (rows, ends.ravel())), shape=(len(ends), count))
        matrix = sparse.vstack([sparse.identity(count), halves]).tocsr() @ matrix
        current = refine(count, current)[1]
    return matrix


def vertex_normal_jacobian(vertices: FloatArray, faces: IntArray) -> sparse.bsr_matrix:
    """Return the derivatives of `vertex_normals` by all coordinates, (3V, 3V) in blocks of 3 x 3.

    With N the sum of cross products around vertex v and e_fj the edge of face f opposite to its corner j,

        dn_v / dx_j = (I - n n^T) / |N| [sum over faces f of v and j of e_fj]_x.
    """
    count = len(vertices)
    corners = vertices[faces]
    own = np.repeat(faces, 3, axis=1).ravel()
    other = np.tile(faces, 3).ravel()
    edges = np.tile(np.roll(corners, -2, axis=1) - np.roll(corners, -1, axis=1), (1, 3, 1)).reshape(-1, 3)
    itself = np.arange(count)
    keys, slot = np.unique(np.concatenate([own * count + other, itself * (count + 1)]), return_inverse=True)
    slot = slot[: len(own)]
    sums = np.stack([np.bincount(slot, edges[:, axis], minlength=len(keys)) for axis in range(3)], 1)
    row, column = keys // count, keys % count
    start = np.searchsorted(row, np.arange(count + 1))
    # The derivatives of N / |N| by N; zeros where N is zero.
    normal = np.zeros((count, 3))
    np.add.at(normal, faces.ravel(), np.repeat(mesh.face_cross_products(vertices, faces), 3, axis=0))
    length = norms(normal)
    inverse = np.divide(1.0, length, out=np.zeros_like(length), where=length > 0)
    unit = normal * inverse[:, None]
    of_unit = inverse[:, None, None] * (np.eye(3) - unit[:, :, None] * unit[:, None, :])
    blocks = of_unit[row] @ cross_matrices(sums.astype(float))
    return sparse.bsr_matrix((blocks, column, start), shape=(3 * count, 3 * count))


def cross_matrices(vectors: FloatArray) -> FloatArray:
    """Return (N, 3, 3) matrices that take w to v x w, of vectors v (N, 3).

    >>> cross_matrices(np.array([[1.0, 0, 0]]))[0] @ [0, 1, 0]
    array([0., 0., 1.])
    """
    return np.cross(vectors[:, None], np.eye(3)).transpose(0, 2, 1)
