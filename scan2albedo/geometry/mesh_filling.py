"""Values at vertices of a mesh that have none, from those around them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.geometry.mesh import edges_with_faces


def filled_over_mesh(values: ArrayLike, known: ArrayLike, faces: IntArray) -> FloatArray:
    """Return values (V, C) where those of unknown vertices are the means of their neighbours.

    Parts of the mesh without any known vertex get the mean of all known values.

    Parameters
    ----------
    values : (V, C) array_like of float
        Whatever, NaN included, where not known.
    known : (V,) array_like of bool
    faces : (F, 3) array of int

    Raises
    ------
    ValueError
        When no vertex is known.

    Examples
    --------
    >>> strip = np.array([[0, 1, 2], [1, 2, 3]])
    >>> filled_over_mesh([[0.0], [np.nan], [np.nan], [1.0]], [True, False, False, True], strip).ravel()
    array([0. , 0.5, 0.5, 1. ])
    """
    from scipy.sparse import coo_matrix, diags
    from scipy.sparse.csgraph import connected_components
    from scipy.sparse.linalg import spsolve

    given, there = np.asarray(values, np.float64), np.asarray(known, np.bool_)
    if not there.any():
        raise ValueError("no vertex is known: there is nothing to fill from")
    result = np.where(there[:, None], given, given[there].mean(0))
    edges, _ = edges_with_faces(faces)
    count = len(given)
    ends = np.concatenate([edges, edges[:, ::-1]])
    links = coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), (count, count)).tocsr()
    parts, part = connected_components(links, directed=False)
    reached = np.bincount(part, there, parts) > 0
    rows = np.flatnonzero(~there & reached[part])
    if len(rows) == 0:
        return result
    degree = np.asarray(links.sum(1)).ravel()
    inner = (diags(degree[rows]) - links[rows][:, rows]).tocsc()
    right = links[rows][:, np.flatnonzero(there)] @ given[there]
    result[rows] = spsolve(inner, right).reshape(len(rows), -1)
    return result
