"""The Laplacian of a lattice by finite volumes and the biharmonic energy it makes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from scan2albedo.eyeglasses.weighting.lattice import CORNERS, Lattice

FloatArray = NDArray[np.float64]

_EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if np.abs(CORNERS[a] - CORNERS[b]).sum() == 1]
"""The 12 edges of a cell as pairs of its corners."""


def node_volumes(lattice: Lattice) -> FloatArray:
    """Return (N,) volumes in cells: an eighth of each cell around a node."""
    return np.bincount(lattice.corners.ravel(), minlength=len(lattice.nodes)) / 8.0


def lattice_laplacian(lattice: Lattice) -> sparse.csr_matrix:
    """Return the symmetric positive semi-definite (N, N) Laplacian L in units of the spacing.

    (L u)_p = sum over neighbours q of a_pq (u_p - u_q), where a_pq is the part of the dual face between
    p and q that lies in cells: a quarter for each cell around the edge, 1 inside. This is the seven-point
    stencil with the natural boundary condition; every off-diagonal entry is <= 0.
    """
    ends = lattice.corners[:, np.array(_EDGES)].reshape(-1, 2)
    count = len(lattice.nodes)
    shape = (count, count)
    half = sparse.csr_matrix((np.full(len(ends), 0.25), (ends[:, 0], ends[:, 1])), shape=shape)
    links = half + half.T
    return (sparse.diags(np.asarray(links.sum(1)).ravel()) - links).tocsr()


def biharmonic_energy(lattice: Lattice) -> sparse.csr_matrix:
    """Return A = L M^-1 L (N, N), with u^T A u the integral of (Laplacian u)^2; M holds the volumes."""
    laplacian = lattice_laplacian(lattice)
    return (laplacian @ sparse.diags(1 / node_volumes(lattice)) @ laplacian).tocsr()
