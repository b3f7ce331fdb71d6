"""Key points as cells of a lattice, checked before anything is solved."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import pdist, squareform

from scan2albedo.errors import EyeglassesError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_COINCIDENT = 1e-6
"""Part of the size below which two key points are one."""


def closest_spacing(handles: FloatArray, size: float, names: Sequence[str]) -> float:
    """Return the spacing (in the mesh's unit) at which no two of the (K, 3) key points share a node.

    `names` (K,) are for messages.

    Raises
    ------
    EyeglassesError
        When two key points coincide.
    """
    if len(handles) < 2:
        return np.inf
    apart = squareform(pdist(handles, "chebyshev"))
    np.fill_diagonal(apart, np.inf)
    a, b = np.unravel_index(int(np.argmin(apart)), apart.shape)
    if not apart[a, b] > _COINCIDENT * size:
        raise EyeglassesError(
            f"key points {_pair(names, a, b)} coincide at {np.round(handles[a], 6).tolist()}; each "
            "needs a place of its own: leave one of them out"
        )
    # Places two spacings apart along one axis lie in cells with another cell between them.
    return float(apart[a, b]) / 2


def cells_of_handles(local: FloatArray, spacing: float, names: Sequence[str]) -> IntArray:
    """Return (K, 3) the cells of key points `local` (K, 3), given in units of the spacing.

    Raises
    ------
    EyeglassesError
        When two key points share a node.
    """
    cells = np.floor(local).astype(np.int64)
    steps = squareform(pdist(cells.astype(float), "chebyshev")) if len(cells) > 1 else np.full((1, 1), np.inf)
    np.fill_diagonal(steps, np.inf)
    a, b = np.unravel_index(int(np.argmin(steps)), steps.shape)
    if steps[a, b] < 2:
        apart = spacing * float(np.abs(local[a] - local[b]).max())
        raise EyeglassesError(
            f"key points {_pair(names, a, b)} are {apart:.4g} apart along the axes, too close for a lattice "
            f"of spacing {spacing:.4g}; give a spacing of {apart / 2:.4g} or less, or raise max_nodes"
        )
    return cells


def _pair(names: Sequence[str], a: np.intp, b: np.intp) -> str:
    return f"{names[int(min(a, b))]} and {names[int(max(a, b))]}"
