"""How vertex normals turn when vertices move."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from scan2albedo.geometry.mesh import face_cross_products

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


def vertex_normal_jacobian(vertices: FloatArray, faces: IntArray) -> sparse.bsr_matrix:
    """Return the derivatives of `vertex_normals` by all coordinates, blocks of 3 x 3.

    With N the sum of cross products around vertex v and e_fj the edge of face f opposite to its corner j,

        dn_v / dx_j = (I - n n^T) / |N| [sum over faces f of v and j of e_fj]_x.

    Parameters
    ----------
    vertices : (V, 3) float64
    faces : (F, 3) int64

    Returns
    -------
    (3V, 3V) block sparse matrix with a block for each vertex and itself, and each pair that shares a face;
    zeros where a vertex has no area around it.
    """
    count = len(vertices)
    corners = vertices[faces]
    opposite = np.roll(corners, -2, axis=1) - np.roll(corners, -1, axis=1)
    own = np.repeat(faces, 3, axis=1).ravel()
    other = np.tile(faces, 3).ravel()
    edges = np.tile(opposite, (1, 3, 1)).reshape(-1, 3)
    itself = np.arange(count)
    keys, slot = np.unique(np.concatenate([own * count + other, itself * (count + 1)]), return_inverse=True)
    slot = slot[: len(own)]
    sums = np.stack([np.bincount(slot, edges[:, axis], minlength=len(keys)) for axis in range(3)], 1)
    row, column = keys // count, keys % count
    start = np.searchsorted(row, np.arange(count + 1))
    blocks = _of_unit(_normal_sums(vertices, faces))[row] @ cross_matrices(sums.astype(np.float64))
    return sparse.bsr_matrix((blocks, column, start), shape=(3 * count, 3 * count))


def cross_matrices(vectors: FloatArray) -> FloatArray:
    """Return (N, 3, 3) matrices that take w to v x w, of vectors v (N, 3).

    >>> cross_matrices(np.array([[1.0, 0, 0]]))[0] @ [0, 1, 0]
    array([0., 0., 1.])
    """
    matrices = np.zeros((len(vectors), 3, 3))
    for axis in range(3):
        after, before = (axis + 1) % 3, (axis + 2) % 3
        matrices[:, before, after] = vectors[:, axis]
        matrices[:, after, before] = -vectors[:, axis]
    return matrices


def _normal_sums(vertices: FloatArray, faces: IntArray) -> FloatArray:
    cross = face_cross_products(vertices, faces)
    flat = np.repeat(cross, 3, axis=0)
    return np.stack([np.bincount(faces.ravel(), flat[:, k], minlength=len(vertices)) for k in range(3)], 1)


def _of_unit(sums: FloatArray) -> FloatArray:
    """Return (V, 3, 3) derivatives of N / |N| by N; zeros where N is zero."""
    length = np.linalg.norm(sums, axis=1)
    inverse = np.divide(1.0, length, out=np.zeros_like(length), where=length > 0)
    unit = sums * inverse[:, None]
    return inverse[:, None, None] * (np.eye(3) - unit[:, :, None] * unit[:, None, :])
