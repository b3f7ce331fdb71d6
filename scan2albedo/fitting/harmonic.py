"""Weights that spread evenly from where they are given."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from scan2albedo.fitting.dynamics import factorized

FloatArray = NDArray[np.float64]


def harmonic_weight(
    matrix: sparse.csr_matrix, fixed: NDArray[np.bool_], one: NDArray[np.bool_]
) -> FloatArray:
    """Return w (C,) with L w = 0, w = 1 where `fixed` and `one`, 0 where `fixed` only; clipped to 0 ... 1.

    Parameters
    ----------
    matrix : (C, C) csr_matrix
        L, the Laplacian of the mesh.
    fixed, one : (C,) bool
    """
    weight = (fixed & one).astype(float)
    free = np.flatnonzero(~fixed)
    inner = matrix[free][:, free] + 1e-9 * sparse.identity(len(free))
    weight[free] = factorized(inner)(-(matrix[free] @ weight)[:, None])[:, 0]
    return np.clip(weight, 0.0, 1.0)
