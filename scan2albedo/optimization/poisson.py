"""Fields rebuilt from gradients inside a region, agreeing with what surrounds it."""

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.linalg import splu

from scan2albedo.core.arrays import BoolArray, FloatArray

_ANCHOR = 1e-9
"""It decides only where a region touches nothing known."""


def integrate_gradients(
    field: FloatArray,
    region: BoolArray,
    known: BoolArray,
    across: FloatArray,
    down: FloatArray,
    anchor: float = _ANCHOR,
) -> FloatArray:
    """Return `field` (H, W) with `region` replaced by the least-squares integral of a gradient [1]_.

    Minimises sum (u_j - u_i - g_ij)^2 over neighbours i, j of which one at least lies in `region` and the
    other in `region` or `known`; u = field on `known`. The system is L u = div g, one row a texel. `across`
    (H, W - 1) and `down` (H - 1, W) are the wanted forward differences; with channels (..., C), all share one
    factorisation. `anchor` is the weight of the old value.

    .. [1] P. Perez, M. Gangnet, A. Blake, "Poisson image editing", SIGGRAPH 2003.
    """
    if not region.any():
        return field
    count, index = int(region.sum()), np.full(field.shape[:2], -1, np.int64)
    index[region] = np.arange(count)
    usable = region | known
    diagonal, right = np.full(count, anchor), anchor * field[region].reshape(count, -1)
    links = []
    for axis, wanted in ((1, across), (0, down)):
        # The first and the second texels of the pairs along the axis.
        ends = [
            tuple(side if a == axis else slice(None) for a in (0, 1))
            for side in (slice(None, -1), slice(1, None))
        ]
        joined = usable[ends[0]] & usable[ends[1]]
        for sign, (here, there) in ((-1, ends), (1, ends[::-1])):
            chosen = joined & region[here]
            row = index[here][chosen]
            free = region[there][chosen].reshape(-1, *[1] * (field.ndim - 2))
            pull = sign * wanted[chosen] + np.where(free, 0.0, field[there][chosen])
            # A texel has one neighbour on each side, so no row comes twice.
            diagonal[row] += 1
            right[row] += pull.reshape(len(row), right.shape[1])
        both = region[ends[0]] & region[ends[1]]
        links.append((index[ends[0]][both], index[ends[1]][both]))
    a, b = (np.concatenate(side) for side in zip(*links, strict=True))
    rows = np.concatenate([b, a, np.arange(count)])
    columns = np.concatenate([a, b, np.arange(count)])
    entries = np.concatenate([-np.ones(2 * len(a)), diagonal])
    system = csr_matrix((entries, (rows, columns)), shape=(count, count)).tocsc()
    result = field.copy()
    result[region] = splu(system).solve(right).reshape(result[region].shape)
    return result
