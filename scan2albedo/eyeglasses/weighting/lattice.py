"""A set of lattice cells with the nodes at their corners, and trilinear interpolation between them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

CORNERS = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)], np.int64)
"""(8, 3) offsets of a cell's corners: corner 4 i + 2 j + k lies at (i, j, k)."""


@dataclass(frozen=True)
class Lattice:
    """Cells and nodes in units of the spacing; cell (i, j, k) is the cube from (i, j, k) to (i + 1, ...).

    Parameters
    ----------
    cells : (C, 3) int64
        Distinct, in lexicographic order.
    nodes : (N, 3) int64
        All corners of the cells, in lexicographic order.
    corners : (C, 8) int64
        Nodes of each cell, in the order of `CORNERS`.
    """

    cells: IntArray
    nodes: IntArray
    corners: IntArray

    @classmethod
    def of_cells(cls, cells: IntArray) -> Lattice:
        """Return the lattice of distinct cells (C, 3) in lexicographic order."""
        low = cells.min(0)
        shape = tuple(cells.max(0) - low + 2)
        places = (cells - low)[:, None, :] + CORNERS
        keys, corners = np.unique(
            np.ravel_multi_index(tuple(np.moveaxis(places, 2, 0)), shape), return_inverse=True
        )
        nodes = np.stack(np.unravel_index(keys, shape), 1).astype(np.int64) + low
        return cls(cells, nodes, corners.reshape(-1, 8).astype(np.int64))

    @cached_property
    def node_components(self) -> IntArray:
        """(N,) labels of the nodes that cells connect."""
        rows, columns = np.repeat(self.corners[:, 0], 7), self.corners[:, 1:].ravel()
        count = len(self.nodes)
        graph = sparse.csr_matrix((np.ones(len(rows), bool), (rows, columns)), shape=(count, count))
        return connected_components(graph, directed=False)[1].astype(np.int64)

    @property
    def cell_components(self) -> IntArray:
        """(C,) labels of the cells that share corners, directly or through others."""
        return self.node_components[self.corners[:, 0]]

    def find(self, cells: IntArray) -> IntArray:
        """Return (P,) indices of the given cells (P, 3) in `cells`, -1 where they are not among them."""
        low, high = self.cells.min(0), self.cells.max(0)
        shape = tuple(high - low + 1)
        within = ((cells >= low) & (cells <= high)).all(1)
        keys = np.ravel_multi_index(tuple((self.cells - low).T), shape)
        wanted = np.ravel_multi_index(tuple((np.where(within[:, None], cells, low) - low).T), shape)
        place = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        return np.where(within & (keys[place] == wanted), place, -1)

    def interpolation(self, points: FloatArray) -> sparse.csr_matrix:
        """Return the (P, N) matrix of trilinear interpolation at points (P, 3) in units of the spacing.

        Rows are non-negative and sum to 1. A point outside all cells takes the value at the nearest place
        of the cell whose centre is nearest.
        """
        cell = self.find(np.floor(points).astype(np.int64))
        outside = np.flatnonzero(cell < 0)
        if len(outside):
            cell[outside] = cKDTree(self.cells + 0.5).query(points[outside])[1]
        upper = np.clip(points - self.cells[cell], 0.0, 1.0)
        axes = np.stack([1.0 - upper, upper], 1)
        shares = axes[:, CORNERS[:, 0], 0] * axes[:, CORNERS[:, 1], 1] * axes[:, CORNERS[:, 2], 2]
        rows = np.repeat(np.arange(len(points)), 8)
        shape = (len(points), len(self.nodes))
        return sparse.csr_matrix((shares.ravel(), (rows, self.corners[cell].ravel())), shape=shape)
