"""Lattice cells around a surface and their nodes: interpolation, the Laplacian, bridges between parts."""

from dataclasses import dataclass
from itertools import combinations
from typing import Self

import numpy as np
from scipy import ndimage, sparse
from scipy.spatial import cKDTree

from scan2albedo.core.arrays import FloatArray, IntArray, norms, row_sums
from scan2albedo.geometry.mesh import vertex_components
from scan2albedo.geometry.rays import blocks

CORNERS = np.argwhere(np.ones((2, 2, 2)))
"""(8, 3) offsets of a cell's corners: corner 4 i + 2 j + k lies at (i, j, k)."""
_EDGES = [(a, b) for a, b in combinations(range(8), 2) if np.abs(CORNERS[a] - CORNERS[b]).sum() == 1]
"""The 12 edges of a cell as pairs of its corners."""
_NEAR = np.argwhere(np.ones((3, 3, 3)))
"""(27, 3) cells from the first one that a triangle of at most 1.5 along each axis may touch."""
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
        nodes, corners = _distinct((cells[:, None] + CORNERS).reshape(-1, 3))
        return cls(cells, nodes, corners.reshape(-1, 8))

    @property
    def cell_components(self) -> IntArray:
        """(C,) labels of the cells that share corners, directly or through others."""
        return vertex_components(len(self.nodes), self.corners)[self.corners[:, 0]]

    def find(self, cells: IntArray) -> IntArray:
        """Return (P,) indices of the given cells (P, 3) in `cells`, -1 where they are not among them."""
        distance, place = cKDTree(self.cells).query(cells)
        return np.where(distance == 0, place, -1)

    def interpolation(self, points: FloatArray) -> sparse.csr_matrix:
        """Return the (P, N) trilinear interpolation at points (P, 3) in spacings; rows >= 0 and sum to 1.

        A point outside all cells takes the value at the nearest place of the cell whose centre is nearest.
        """
        cell = self.find(np.floor(points).astype(int))
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
    return (sparse.diags(row_sums(links)) - links).tocsr()


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
            walked, total = np.zeros(3, int), np.abs(way)
            while (walked < total).any():
                axis = np.argmax(np.where(walked < total, total - walked, 0) / np.maximum(total, 1))
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
    room, corners = 64 * limit, np.floor(triangles.reshape(-1, 3)).astype(int)
    sides = np.roll(triangles, -1, 1) - triangles
    normal = np.cross(sides[:, 0], sides[:, 1])
    # A surface of area a touches a / sqrt(3) cells at least, once overlaps are left out of account.
    if norms(normal).sum() > 2 * room:
        return None
    left = triangles[np.abs(normal).max(1) > _TIE * (sides**2).sum(2).max(1)]
    small, found = [left[:0]], [corners]
    while len(left):
        # Large ones are halved across their longest side, from a to b: they cost their area, not their box.
        large = np.ptp(left, axis=1).max(1) > 1.5
        small, left = [*small, left[~large]], left[large]
        longest = norms(np.roll(left, -1, 1) - left).argmax(1)[:, None]
        a, b, c = np.take_along_axis(left, (longest + np.arange(3))[..., None] % 3, 1).transpose(1, 0, 2)
        middle = (a + b) / 2
        left = np.concatenate([np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)])
        if len(left) > room:
            return None
    pieces = np.concatenate(small)
    for block in blocks(len(pieces), 2**14):
        piece = pieces[block]
        low, high = (np.floor(side).astype(int) for side in (piece.min(1) - _TIE, piece.max(1) + _TIE))
        owner, offset = np.nonzero(((high - low)[:, None] >= _NEAR).all(2))
        cells = low[owner] + _NEAR[offset]
        # From the cell's middle. Axes: the normal, and edge x coordinate axis, in each of three projections.
        corner = piece[owner] - cells[:, None] - 0.5
        sides = np.roll(corner, -1, 1) - corner
        axes = np.cross(sides[:, :, None], np.eye(3)).reshape(-1, 9, 3)
        axes = np.concatenate([axes, np.cross(sides[:, 0], sides[:, 1])[:, None]], 1)
        along, reach = axes @ corner.transpose(0, 2, 1), np.abs(axes).sum(2) / 2 * (1 + _TIE)
        found.append(cells[((along.min(2) <= reach) & (along.max(2) >= -reach)).all(1)])
        if sum(map(len, found)) > room + len(corners):
            return None
    return unique_cells(np.concatenate(found))


def unique_cells(cells: IntArray) -> IntArray:
    """Return the distinct cells in lexicographic order."""
    return _distinct(cells)[0]


def _distinct(places: IntArray) -> tuple[IntArray, IntArray]:
    """Return distinct places (D, 3) in lexicographic order, and which of them each of (N, 3) is."""
    low = places.min(0)
    shape = tuple(places.max(0) - low + 1)
    keys, number = np.unique(np.ravel_multi_index(tuple((places - low).T), shape), return_inverse=True)
    return np.stack(np.unravel_index(keys, shape), 1).astype(int) + low, number.astype(int)


def enclosed_cells(cells: IntArray) -> IntArray:
    """Return the cells (E, 3) that `cells` (C, 3) enclose; none in boxes of over 2^26 cells."""
    low = cells.min(0) - 1
    shape = cells.max(0) - low + 2
    if np.prod(shape, dtype=float) > 2**26:
        return np.zeros((0, 3), int)
    walls = np.zeros(tuple(shape), bool)
    walls[tuple((cells - low).T)] = True
    return np.argwhere(ndimage.binary_fill_holes(walls) & ~walls).astype(int) + low
