"""Fields rebuilt from gradients inside a region, agreeing with what surrounds it."""

import numpy as np
from scipy.sparse import csr_matrix, identity
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
    number, usable = np.arange(region.size).reshape(region.shape), region | known
    values, pairs, steps = field.reshape(region.size, -1).astype(np.float64), [], []
    for axis, wanted in ((1, across), (0, down)):
        here, there = ((slice(None),) * axis + (part,) for part in (slice(None, -1), slice(1, None)))
        joined = usable[here] & usable[there] & (region[here] | region[there])
        pairs.append(np.stack([number[here][joined], number[there][joined]]))
        steps.append(wanted[joined].reshape(-1, values.shape[1]))
    # One row a pair of neighbours: the step from the first one to the second.
    columns = np.concatenate(pairs, axis=1)
    each = np.arange(columns.shape[1])
    signs = np.repeat([-1.0, 1.0], len(each))
    step = csr_matrix((signs, (np.tile(each, 2), columns.ravel())), (len(each), region.size))
    outside = np.where(region.reshape(-1, 1), 0.0, values)
    inside, free = values[region.ravel()], step.tocsc()[:, region.ravel()]
    right = free.T @ (np.concatenate(steps) - step @ outside) + anchor * inside
    result = field.copy()
    system = free.T @ free + anchor * identity(len(inside), format="csc")
    result[region] = splu(system.tocsc()).solve(right).reshape(result[region].shape)
    return result
