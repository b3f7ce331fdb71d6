"""Average a scan that is finer than the fit can follow, so that its noise averages out too."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

SPREAD_PER_PASS = 0.43
"""Variance along each axis that one average over a vertex and its neighbours adds, per edge length^2."""
REACH = 0.6
"""Standard deviation of the say of neighbours with their distance, per scale (or usual edge, if longer).

Without it a vertex whose neighbours are 8 mm away would be averaged with them as one 0.5 mm away is.
"""
SPIKE = 6.0
"""Vertices this many times farther from their neighbours' mean than the median, and than any of them."""
MAX_PASSES = 40


def smoothed(
    vertices: FloatArray,
    faces: IntArray,
    boundary: BoolArray,
    scale_mm: float,
    count: FloatArray | None = None,
    *,
    keep_curvature: bool = False,
) -> FloatArray:
    """Return the vertices (V, 3) averaged over about `scale_mm` (a standard deviation) of surface.

    As many averages over the neighbours as the length of the edges asks for, none when edges are as long as
    the scale. Borders stay; spikes have no say, and move to where their neighbours are.

    Averages flatten what is curved. With `keep_curvature` what they took away is averaged as well and given
    back ("twicing"): 2 S - S^2 in place of S, at about a third more noise.

    Parameters
    ----------
    vertices : (V, 3) float64
    faces : (F, 3) int64
    boundary : (V,) bool
    scale_mm : float
    count : (V,) float64, optional
        How many measurements each vertex is the mean of: its say.
    keep_curvature : bool

    References
    ----------
    .. [1] J. W. Tukey, "Exploratory Data Analysis", 1977, section 16 (twicing).
    """
    edge_mm = float(np.median(np.linalg.norm(vertices[faces[:, 0]] - vertices[faces[:, 1]], axis=1)))
    passes = min(int(scale_mm**2 / (SPREAD_PER_PASS * max(edge_mm, 1e-9) ** 2) + 0.5), MAX_PASSES)
    if passes == 0:
        return vertices
    joined = _neighbours(len(vertices), faces)
    spike = _spikes(vertices, joined)
    say = np.where(spike, 0.0, 1.0 if count is None else count)
    weights = _weights(vertices, joined, spike, say, REACH * max(scale_mm, edge_mm))
    total = np.asarray(weights.sum(1))
    still = boundary[:, None] | (total < 1e-9)

    def averaged(values: FloatArray, at_border: FloatArray) -> FloatArray:
        for _ in range(passes):
            values = np.where(still, at_border, (weights @ values) / np.maximum(total, 1e-9))
        return values

    points = averaged(vertices, vertices)
    if not keep_curvature:
        return points
    return points + averaged(vertices - points, np.zeros_like(points))


def _neighbours(count: int, faces: IntArray) -> sparse.csr_matrix:
    start, end = faces[:, [0, 1, 2]].ravel(), faces[:, [1, 2, 0]].ravel()
    directed = sparse.csr_matrix((np.ones(len(start)), (start, end)), shape=(count, count))
    joined = directed + directed.T
    joined.data[:] = 1.0
    return joined


def _spikes(vertices: FloatArray, joined: sparse.csr_matrix) -> BoolArray:
    degree = np.maximum(np.diff(joined.indptr), 1)
    gap = np.linalg.norm((joined @ vertices) / degree[:, None] - vertices, axis=1)
    around = joined.multiply(gap).max(axis=1).toarray().ravel()
    return np.asarray((gap > SPIKE * np.median(gap)) & (gap > around))


def _weights(
    vertices: FloatArray, joined: sparse.csr_matrix, spike: BoolArray, say: FloatArray, reach_mm: float
) -> sparse.csr_matrix:
    """Return (V, V) what each vertex (row) takes from itself and its neighbours; spikes from all alike."""
    row = np.repeat(np.arange(len(vertices)), np.diff(joined.indptr))
    length = np.linalg.norm(vertices[row] - vertices[joined.indices], axis=1)
    near = np.where(spike[row], 1.0, np.exp(-0.5 * (length / reach_mm) ** 2))
    around = sparse.csr_matrix((near * say[joined.indices], joined.indices, joined.indptr), joined.shape)
    return sparse.csr_matrix(around + sparse.diags(say))
