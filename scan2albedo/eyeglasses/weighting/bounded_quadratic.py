"""Quadratic problems between bounds by projected Newton steps, many right-hand sides on one matrix."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse

from scan2albedo.core import Meter
from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.eyeglasses.weighting.sparse_cholesky import SparseCholesky

_SUFFICIENT = 1e-4
"""Part of the decrease predicted by the gradient that a step has to bring (Armijo)."""
_SHORTEST = 1e-10
"""Step length below which rounding, not the direction, is what stops a column."""
_ROUNDING = 1e-13
"""Scaled gradients below this have no sign."""


@dataclass(frozen=True)
class BoundedMinimum:
    """Minima of `minimize_bounded` for K columns: `x` (N, K) in [0, 1], after `steps` (K,) Newton steps.

    `residual` (K,) is that of `optimality_residual`.
    """

    x: FloatArray
    residual: FloatArray
    steps: IntArray


def minimize_bounded(
    matrix: sparse.csr_matrix,
    right: FloatArray,
    start: FloatArray,
    *,
    tolerance: float,
    max_steps: int,
    meter: Meter,
) -> BoundedMinimum:
    """Minimise x^T A x / 2 - b^T x over 0 <= x <= 1 for each column b (N,) of `right`, A positive definite.

    Projected Newton [1]_: entries at a bound that are pushed outward stay, the others take the Newton step
    A_FF d = -g_F and are clipped back into the bounds; the step is halved until the energy falls. It falls in
    every step, so a budget that ends early keeps the best so far. A column is done when its scaled residual
    is at most `tolerance`, or after `max_steps`; the meter counts the steps of all columns. Entries of
    `start` (N, K), in [0, 1], at a bound stay there in the first step, so that a start from a coarser
    lattice, whose gradient is rough, hands on its active set.

    .. [1] D. P. Bertsekas, "Projected Newton methods for optimization problems with simple constraints",
       SIAM J. Control and Optimization 20(2), 1982, section 2.
    """
    system = SparseCholesky(matrix)
    # Columns one after another in memory: the loop below takes them one by one.
    x, b = (np.asfortranarray(values[system.order]) for values in (start, right))
    product, diagonal = np.asfortranarray(system.matrix @ x), system.matrix.diagonal()
    residual = optimality_residual(x, product - b, diagonal)
    steps = np.zeros(b.shape[1], np.int64)
    for k in range(b.shape[1]):
        held = (x[:, k] <= 0) | (x[:, k] >= 1)
        while not meter.exhausted and residual[k] > tolerance and steps[k] < max_steps:
            moved = _step(system, b[:, k], x[:, k], product[:, k], held)
            meter.count()
            steps[k] += 1
            if moved is None and steps[k] > 1:
                break
            if moved is not None:
                x[:, k], product[:, k] = moved
            gradient = product[:, k] - b[:, k]
            held = _pushed_out(x[:, k], gradient, diagonal)
            residual[k] = optimality_residual(x[:, k], gradient, diagonal)
            meter.record(residual.max())
    result = np.empty_like(start)
    result[system.order] = x
    return BoundedMinimum(result, residual, steps)


def optimality_residual(x: FloatArray, gradient: FloatArray, diagonal: FloatArray) -> Any:
    """Return each column's max |x - clip(x - g / diag(A), 0, 1)|, a length in x; 0 only at the minimum."""
    scaled = gradient / (diagonal if x.ndim == 1 else diagonal[:, None])
    return np.abs(x - np.clip(x - scaled, 0.0, 1.0)).max(0, initial=0.0)


def _pushed_out(x: FloatArray, gradient: FloatArray, diagonal: FloatArray) -> BoolArray:
    """Return (N,) True where x sits at a bound and the energy pushes it outward."""
    least = _ROUNDING * diagonal
    return ((x <= 0) & (gradient > least)) | ((x >= 1) & (gradient < -least))


def _step(
    system: SparseCholesky, b: FloatArray, x: FloatArray, product: FloatArray, held: BoolArray
) -> tuple[FloatArray, FloatArray] | None:
    """Return (x, A x) after a projected Newton step of the entries not `held`; None if no energy falls."""
    gradient = product - b
    system.refill(held)
    direction = system.solve(np.where(held, 0.0, -gradient))
    length = 1.0
    while length > _SHORTEST:
        trial = np.clip(x + length * direction, 0.0, 1.0)
        change = trial - x
        after = system.matrix @ trial
        # Differences of the energy itself would drown in rounding near the minimum.
        predicted = float(gradient @ change)
        if predicted + 0.5 * float(change @ (after - product)) <= _SUFFICIENT * predicted < 0:
            return trial, after
        length /= 2
    return None
