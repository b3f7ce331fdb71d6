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
SPIKE = 6.0
"""Vertices this many times farther from their neighbours' mean than the median, and than any of them."""
MAX_PASSES = 40


def smoothed(vertices: FloatArray, faces: IntArray, boundary: BoolArray, scale_mm: float) -> FloatArray:
    """Return the vertices (V, 3) averaged over about `scale_mm` (a standard deviation) of surface.

    As many averages over the neighbours as the length of the edges asks for, none when edges are as long as
    the scale. Borders stay; spikes have no say, and move to where their neighbours are.

    Parameters
    ----------
    vertices : (V, 3) float64
    faces : (F, 3) int64
    boundary : (V,) bool
    scale_mm : float
    """
    edge_mm = float(np.median(np.linalg.norm(vertices[faces[:, 0]] - vertices[faces[:, 1]], axis=1)))
    passes = min(int(scale_mm**2 / (SPREAD_PER_PASS * max(edge_mm, 1e-9) ** 2) + 0.5), MAX_PASSES)
    if passes == 0:
        return vertices
    joined = _neighbours(len(vertices), faces)
    gap = np.linalg.norm(_mean(joined, vertices) - vertices, axis=1)
    around = joined.multiply(gap).max(axis=1).toarray().ravel()
    spike = (gap > SPIKE * np.median(gap)) & (gap > around)
    counted = joined @ sparse.diags((~spike).astype(float)) + sparse.diags((~spike).astype(float))
    counted = sparse.csr_matrix(counted)
    counted.eliminate_zeros()
    still = boundary | (np.asarray(counted.sum(1)).ravel() == 0)
    points = vertices
    for _ in range(passes):
        points = np.where(still[:, None], vertices, _mean(counted, points))
    return points


def _neighbours(count: int, faces: IntArray) -> sparse.csr_matrix:
    start, end = faces[:, [0, 1, 2]].ravel(), faces[:, [1, 2, 0]].ravel()
    directed = sparse.csr_matrix((np.ones(len(start)), (start, end)), shape=(count, count))
    joined = directed + directed.T
    joined.data[:] = 1.0
    return joined


def _mean(weights: sparse.csr_matrix, points: FloatArray) -> FloatArray:
    total = np.asarray(weights.sum(1)).ravel()
    return np.asarray(weights @ points) / np.maximum(total, 1.0)[:, None]
