"""Cells that join the parts of a lattice: frames come in many pieces that only look connected."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scan2albedo.eyeglasses.weighting.lattice import Lattice
from scan2albedo.eyeglasses.weighting.voxelization import unique_cells

IntArray = NDArray[np.int64]


def join_parts(cells: IntArray, reach: float) -> IntArray:
    """Return `cells` (C, 3) with the gaps of at most `reach` (in cells) between its parts bridged.

    Parts are bridged along the minimum spanning forest of their distances, each by one straight chain of
    cells between the nearest two. Parts farther away from all others stay apart.
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
            added.append(_chain(cells[partner[nearest]], cells[nearest]))
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


def _chain(start: IntArray, end: IntArray) -> IntArray:
    """Return the cells (n, 3) of a straight walk from `start` to `end` through shared faces."""
    here, total = start.copy(), np.abs(end - start)
    walked, cells = np.zeros(3, np.int64), [start.copy()]
    while (walked < total).any():
        # The axis that lags most behind the straight line goes next.
        axis = int(np.argmax(np.where(walked < total, total - walked, 0) / np.maximum(total, 1)))
        here[axis] += np.sign(end - start)[axis]
        walked[axis] += 1
        cells.append(here.copy())
    return np.array(cells)
