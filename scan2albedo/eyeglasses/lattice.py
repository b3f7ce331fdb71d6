"""Lattice cells around a surface and their nodes: interpolation, the Laplacian, bridges between parts."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numba import njit
from scipy import ndimage, sparse
from scipy.spatial import cKDTree

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.geometry.mesh import vertex_components

CORNERS = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)], np.int64)
"""(8, 3) offsets of a cell's corners: corner 4 i + 2 j + k lies at (i, j, k)."""
_EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if np.abs(CORNERS[a] - CORNERS[b]).sum() == 1]
"""The 12 edges of a cell as pairs of its corners."""
_TIE = 1e-9
"""Cells below which rounding does not decide: a triangle this near to a cell touches it, and one whose height
is this part of its length has no area."""


@dataclass(frozen=True)
class Lattice:
    """Cells and nodes in units of the spacing; cell (i, j, k) is the cube from (i, j, k) to (i + 1, ...).

    Distinct `cells` (C, 3) and all their corners, the `nodes` (N, 3), are in lexicographic order; `corners`
    (C, 8) are the nodes of each cell, in the order of `CORNERS`.
    """

    cells: IntArray
    nodes: IntArray
    corners: IntArray

    @classmethod
    def of_cells(cls, cells: IntArray) -> Self:
        """Return the lattice of distinct cells (C, 3) in lexicographic order."""
        low = cells.min(0)
        shape = tuple(cells.max(0) - low + 2)
        keys = np.ravel_multi_index(tuple(np.moveaxis((cells - low)[:, None] + CORNERS, 2, 0)), shape)
        keys, corners = np.unique(keys, return_inverse=True)
        nodes = np.stack(np.unravel_index(keys, shape), 1).astype(np.int64) + low
        return cls(cells, nodes, corners.reshape(-1, 8).astype(np.int64))

    @property
    def cell_components(self) -> IntArray:
        """(C,) labels of the cells that share corners, directly or through others."""
        return vertex_components(len(self.nodes), self.corners)[self.corners[:, 0]]

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
        """Return the (P, N) trilinear interpolation at points (P, 3) in spacings; rows >= 0 and sum to 1.

        A point outside all cells takes the value at the nearest place of the cell whose centre is nearest.
        """
        cell = self.find(np.floor(points).astype(np.int64))
        outside = np.flatnonzero(cell < 0)
        if len(outside):
            cell[outside] = cKDTree(self.cells + 0.5).query(points[outside])[1]
        upper = np.clip(points - self.cells[cell], 0.0, 1.0)
        axes = np.stack([1.0 - upper, upper], 1)
        shares = axes[:, CORNERS[:, 0], 0] * axes[:, CORNERS[:, 1], 1] * axes[:, CORNERS[:, 2], 2]
        places = np.repeat(np.arange(len(points)), 8), self.corners[cell].ravel()
        return sparse.csr_matrix((shares.ravel(), places), shape=(len(points), len(self.nodes)))


def node_volumes(lattice: Lattice) -> FloatArray:
    """Return (N,) volumes in cells: an eighth of each cell around a node."""
    return np.bincount(lattice.corners.ravel()) / 8.0


def lattice_laplacian(lattice: Lattice) -> sparse.csr_matrix:
    """Return the symmetric positive semi-definite (N, N) Laplacian L in units of the spacing.

    (L u)_p = sum over neighbours q of a_pq (u_p - u_q), where a_pq is the part of the dual face between
    p and q that lies in cells, 1 inside.
    """
    ends = lattice.corners[:, np.array(_EDGES)].reshape(-1, 2)
    shape = (len(lattice.nodes),) * 2
    half = sparse.csr_matrix((np.full(len(ends), 1 / 4), (ends[:, 0], ends[:, 1])), shape=shape)
    links = half + half.T
    return (sparse.diags(np.asarray(links.sum(1)).ravel()) - links).tocsr()


def biharmonic_energy(lattice: Lattice) -> sparse.csr_matrix:
    """Return A = L M^-1 L (N, N), with u^T A u the integral of (Laplacian u)^2; M holds the volumes."""
    laplacian = lattice_laplacian(lattice)
    return (laplacian @ sparse.diags(1 / node_volumes(lattice)) @ laplacian).tocsr()


def join_parts(cells: IntArray, reach: float) -> IntArray:
    """Return `cells` (C, 3) with the gaps of at most `reach` (in cells) between its parts bridged.

    Along the minimum spanning forest of their distances, by straight chains of cells between the nearest two.
    """
    label = Lattice.of_cells(cells).cell_components
    sizes = np.bincount(label)
    added = [cells]
    gap, partner = np.full(len(cells), np.inf), np.full(len(cells), -1)
    waiting = np.ones(len(cells), bool)
    # Prim's algorithm; where nothing is in reach any more the largest part left starts the next tree.
    while waiting.any():
        rest = np.flatnonzero(waiting)
        nearest = rest[np.argmin(gap[rest])]
        if gap[nearest] <= reach:
            part = label[nearest]
            # A straight walk through shared faces: the axis that lags most behind the line goes next.
            here, way = cells[partner[nearest]].copy(), cells[nearest] - cells[partner[nearest]]
            walked, total = np.zeros(3, np.int64), np.abs(way)
            while (walked < total).any():
                axis = int(np.argmax(np.where(walked < total, total - walked, 0) / np.maximum(total, 1)))
                here[axis] += np.sign(way[axis])
                walked[axis] += 1
                added.append(here[None].copy())
        else:
            part = label[rest[np.argmax(sizes[label[rest]])]]
        joined = np.flatnonzero(label == part)
        waiting[joined] = False
        rest = np.flatnonzero(waiting)
        if len(rest):
            distance, index = cKDTree(cells[joined]).query(cells[rest], distance_upper_bound=reach + 1e-9)
            closer = distance < gap[rest]
            gap[rest[closer]], partner[rest[closer]] = distance[closer], joined[index[closer]]
    return unique_cells(np.concatenate(added)) if len(added) > 1 else cells


def surface_cells(triangles: FloatArray, limit: int) -> IntArray | None:
    """Return the unique cells (C, 3) that triangles (T, 3, 3) touch, None where they are far beyond `limit`.

    Lengths are in lattice spacings; cells are closed cubes, the test is exact (separating axes). A triangle
    without area contributes the cells of its corners.
    """
    # Every cell is found by the few triangles that touch it; 64 times the limit is beyond any mesh's share.
    room = 64 * limit
    corners = np.floor(triangles.reshape(-1, 3)).astype(np.int64)
    first, second = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    area = 0.5 * np.linalg.norm(np.cross(first, second), axis=1)
    # A surface of area a touches a / sqrt(3) cells at least, once overlaps are left out of account.
    if area.sum() > room:
        return None
    count = _touched(triangles, np.empty((0, 3), np.int64), room)
    if count > room:
        return None
    found = np.empty((count, 3), np.int64)
    _touched(triangles, found, room)
    return unique_cells(np.concatenate([corners, found]))


def unique_cells(cells: IntArray) -> IntArray:
    """Return the distinct cells in lexicographic order."""
    low = cells.min(0)
    shape = cells.max(0) - low + 1
    keys = np.unique(np.ravel_multi_index(tuple((cells - low).T), tuple(shape)))
    return np.stack(np.unravel_index(keys, tuple(shape)), 1).astype(np.int64) + low


def enclosed_cells(cells: IntArray) -> IntArray:
    """Return the cells (E, 3) that `cells` (C, 3) enclose; none in boxes of over 2^26 cells."""
    low = cells.min(0) - 1
    shape = cells.max(0) - low + 2
    if float(np.prod(shape.astype(float))) > 2**26:
        return np.zeros((0, 3), np.int64)
    empty = np.ones(tuple(shape), bool)
    empty[tuple((cells - low).T)] = False
    regions, _ = ndimage.label(empty)
    return np.argwhere(empty & (regions != regions[0, 0, 0])).astype(np.int64) + low


@njit(cache=True, nogil=True)
def _touched(triangles, found, room):  # type: ignore[no-untyped-def]
    """Write the cells each triangle touches into `found` (as far as it has rows) and return their number."""
    count = 0
    normal, low, high = np.empty(3), np.empty(3, np.int64), np.empty(3, np.int64)
    cell = np.empty(3, np.int64)
    for t in range(triangles.shape[0]):
        p = triangles[t]
        longest = 0.0
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            normal[i] = (p[1, a] - p[0, a]) * (p[2, b] - p[0, b]) - (p[1, b] - p[0, b]) * (p[2, a] - p[0, a])
            low[i] = int(np.floor(min(p[0, i], p[1, i], p[2, i]) - _TIE))
            high[i] = int(np.floor(max(p[0, i], p[1, i], p[2, i]) + _TIE))
            side = 0.0
            for k in range(3):
                side += (p[a, k] - p[i, k]) ** 2
            longest = max(longest, side)
        axis = 0
        for i in range(1, 3):
            if abs(normal[i]) > abs(normal[axis]):
                axis = i
        if abs(normal[axis]) <= _TIE * longest:
            continue
        u, v = (axis + 1) % 3, (axis + 2) % 3
        slope_u, slope_v = -normal[u] / normal[axis], -normal[v] / normal[axis]
        spread = 0.5 * (abs(slope_u) + abs(slope_v)) + 1e-4
        # Column by column along the normal's longest axis: a large triangle costs its area, not its box.
        for i in range(low[u], high[u] + 1):
            for j in range(low[v], high[v] + 1):
                middle = p[0, axis] + slope_u * (i + 0.5 - p[0, u]) + slope_v * (j + 0.5 - p[0, v])
                first = max(low[axis], int(np.floor(middle - spread)))
                last = min(high[axis], int(np.floor(middle + spread)))
                for k in range(first, last + 1):
                    cell[u], cell[v], cell[axis] = i, j, k
                    if _overlap(p, normal, cell):
                        if count < found.shape[0]:
                            found[count] = cell
                        count += 1
            if count > room:
                return count
    return count


@njit(cache=True, nogil=True)
def _overlap(p, normal, cell):  # type: ignore[no-untyped-def]
    """Return whether triangle p (3, 3) meets the closed cube at `cell`, whose box it is known to meet."""
    reach = 0.5 * (abs(normal[0]) + abs(normal[1]) + abs(normal[2]))
    offset = 0.0
    for i in range(3):
        offset += normal[i] * (cell[i] + 0.5 - p[0, i])
    if abs(offset) > reach * (1 + _TIE):
        return False
    # Axes: edge x coordinate axis, that is the edge's normal in each of the three projections.
    for e in range(3):
        s, other = (e + 1) % 3, (e + 2) % 3
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            da, db = p[s, a] - p[e, a], p[s, b] - p[e, b]
            here = da * (p[e, b] - cell[b] - 0.5) - db * (p[e, a] - cell[a] - 0.5)
            there = da * (p[other, b] - cell[b] - 0.5) - db * (p[other, a] - cell[a] - 0.5)
            radius = 0.5 * (abs(da) + abs(db)) * (1 + _TIE)
            if min(here, there) > radius or max(here, there) < -radius:
                return False
    return True
