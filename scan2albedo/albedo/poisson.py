"""Fields rebuilt from gradients inside a region, agreeing with what surrounds it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.linalg import splu

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_ANCHOR = 1e-9
"""Weight of the old value: it decides only where a region touches nothing known."""


def forward_differences(field: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return f[i, j + 1] - f[i, j] (H, W - 1) and f[i + 1, j] - f[i, j] (H - 1, W)."""
    return np.diff(field, axis=1), np.diff(field, axis=0)


def integrate_gradients(
    field: FloatArray, region: BoolArray, known: BoolArray, across: FloatArray, down: FloatArray
) -> FloatArray:
    """Return `field` (H, W) with `region` replaced by the least-squares integral of a gradient.

    Minimises sum (u_j - u_i - g_ij)^2 over neighbours i, j of which one at least lies in `region` and the
    other in `region` or `known`; u = field on `known`. The system is L u = div g, one row a texel.

    Parameters
    ----------
    field : (H, W) float64
    region, known : (H, W) bool
        Unknown texels; texels that keep their value.
    across, down : (H, W - 1), (H - 1, W) float64
        Wanted forward differences.

    References
    ----------
    .. [1] P. Perez, M. Gangnet, A. Blake, "Poisson image editing", SIGGRAPH 2003.
    """
    if not region.any():
        return field
    index = np.full(field.shape, -1, np.int64)
    index[region] = np.arange(int(region.sum()))
    flat_index, flat_field = index.ravel(), field.ravel()
    usable = (region | (known & ~region)).ravel()
    grid = np.arange(field.size).reshape(field.shape)
    first = np.concatenate([grid[:, :-1].ravel(), grid[:-1].ravel()])
    second = np.concatenate([grid[:, 1:].ravel(), grid[1:].ravel()])
    wanted = np.concatenate([across.ravel(), down.ravel()])
    chosen = usable[first] & usable[second] & ((flat_index[first] >= 0) | (flat_index[second] >= 0))
    first, second, wanted = first[chosen], second[chosen], wanted[chosen]

    count = int(region.sum())
    right = _ANCHOR * field[region]
    diagonal = np.full(count, _ANCHOR)
    for here, there, gradient in ((first, second, -wanted), (second, first, wanted)):
        inside = flat_index[here] >= 0
        row = flat_index[here][inside]
        outside = flat_index[there][inside] < 0
        diagonal += np.bincount(row, minlength=count)
        right += np.bincount(row, gradient[inside] + outside * flat_field[there][inside], count)
    both = (flat_index[first] >= 0) & (flat_index[second] >= 0)
    a, b = flat_index[first][both], flat_index[second][both]
    rows = np.concatenate([a, b, np.arange(count)])
    columns = np.concatenate([b, a, np.arange(count)])
    entries = np.concatenate([-np.ones(2 * len(a)), diagonal])
    system = csr_matrix((entries, (rows, columns)), shape=(count, count)).tocsc()
    result = field.copy()
    result[region] = splu(system).solve(right)
    return result
