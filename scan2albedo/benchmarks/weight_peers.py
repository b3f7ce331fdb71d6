"""Bounded biharmonic weights by libigl, on the lattice of ours cut into tetrahedra."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from scan2albedo.eyeglasses.weighting.embedding import Embedding
from scan2albedo.eyeglasses.weighting.lattice import CORNERS, Lattice

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


def kuhn_tetrahedra(lattice: Lattice) -> IntArray:
    """Return (T, 4) nodes of the tetrahedra, six a cell, in which neighbouring cells agree (Kuhn)."""
    number = {tuple(corner): n for n, corner in enumerate(CORNERS.tolist())}
    paths = []
    for axes in itertools.permutations(range(3)):
        place, path = [0, 0, 0], [0]
        for axis in axes:
            place[axis] = 1
            path.append(number[tuple(place)])
        paths.append(path)
    return np.ascontiguousarray(lattice.corners[:, np.array(paths)].reshape(-1, 4), np.int64)


def fixed_nodes(embedding: Embedding) -> tuple[IntArray, FloatArray]:
    """Return the nodes (8 K,) whose weights the handles fix, and these weights (8 K, K)."""
    count = len(embedding.handle_cells)
    fixed = embedding.lattice.corners[embedding.lattice.find(embedding.handle_cells)].ravel()
    return fixed, np.repeat(np.eye(count), 8, 0)


def igl_bbw(embedding: Embedding, iterations: int = 100) -> FloatArray:
    """Return libigl's weights (N, K) of the lattice's nodes, not normalised.

    References
    ----------
    .. [1] A. Jacobson, I. Baran, J. Popovic, O. Sorkine, "Bounded biharmonic weights for real-time
       deformation", SIGGRAPH 2011.
    """
    import igl

    lattice = embedding.lattice
    nodes = lattice.nodes.astype(float)
    fixed, values = fixed_nodes(embedding)
    return np.asarray(igl.bbw(nodes, kuhn_tetrahedra(lattice), fixed, values, max_iter=iterations))
