"""The cells of a regular lattice that a triangle surface touches or encloses."""

from __future__ import annotations

import numpy as np
from numba import njit
from scipy import ndimage

from scan2albedo.core.arrays import FloatArray, IntArray

_TOUCH = 1e-9
"""Cells; a triangle this near to a cell touches it, so that rounding does not decide on a tie."""
_FLAT = 1e-9
"""Height over length below which a triangle has no area; its corners still count."""
_MAX_BOX = 1 << 26
"""Cells of the largest box in which enclosed cells are looked for (one byte and one label each)."""


def surface_cells(triangles: FloatArray, limit: int) -> IntArray | None:
    """Return the unique cells (C, 3) that triangles (T, 3, 3) touch, None where they are far beyond `limit`.

    Lengths are in lattice spacings; cell (i, j, k) is the closed cube [i, i + 1] x [j, j + 1] x [k, k + 1]
    and the test is exact (separating axes). Winding, repetitions and holes do not matter. A triangle without
    area contributes the cells of its corners. `limit` keeps a far too fine spacing from filling the memory.
    """
    # Every cell is found by the few triangles that touch it; 64 times the limit is beyond any mesh's share.
    room = 64 * limit
    corners = np.floor(triangles.reshape(-1, 3)).astype(np.int64)
    area = 0.5 * np.linalg.norm(
        np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1
    )
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
    """Return the cells (E, 3) that `cells` (C, 3) enclose.

    Holes smaller than a cell are closed; larger ones leave the part hollow, as do boxes of over 2^26 cells.
    """
    low = cells.min(0) - 1
    shape = cells.max(0) - low + 2
    if float(np.prod(shape.astype(float))) > _MAX_BOX:
        return np.zeros((0, 3), np.int64)
    empty = np.ones(tuple(shape), bool)
    empty[tuple((cells - low).T)] = False
    regions, _ = ndimage.label(empty)
    inside = empty & (regions != regions[0, 0, 0])
    return np.argwhere(inside).astype(np.int64) + low


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
            low[i] = int(np.floor(min(p[0, i], p[1, i], p[2, i]) - _TOUCH))
            high[i] = int(np.floor(max(p[0, i], p[1, i], p[2, i]) + _TOUCH))
            side = 0.0
            for k in range(3):
                side += (p[a, k] - p[i, k]) ** 2
            longest = max(longest, side)
        axis = 0
        for i in range(1, 3):
            if abs(normal[i]) > abs(normal[axis]):
                axis = i
        if abs(normal[axis]) <= _FLAT * longest:
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
    if abs(offset) > reach * (1 + _TOUCH):
        return False
    # Axes: edge x coordinate axis, that is the edge's normal in each of the three projections.
    for e in range(3):
        s, other = (e + 1) % 3, (e + 2) % 3
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            da, db = p[s, a] - p[e, a], p[s, b] - p[e, b]
            here = da * (p[e, b] - cell[b] - 0.5) - db * (p[e, a] - cell[a] - 0.5)
            there = da * (p[other, b] - cell[b] - 0.5) - db * (p[other, a] - cell[a] - 0.5)
            radius = 0.5 * (abs(da) + abs(db)) * (1 + _TOUCH)
            if min(here, there) > radius or max(here, there) < -radius:
                return False
    return True
