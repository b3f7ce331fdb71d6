"""Simulated annealing over a box with steps that adapt to each coordinate."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from scan2albedo.core import Meter
from scan2albedo.core.arrays import ArrayLike, FloatArray

_FINAL_TEMPERATURE = 1e-4
"""In units of the spread of the first costs."""
_ACCEPTANCE = 0.44
"""Acceptance rate that the step lengths are steered to (one coordinate moves at a time)."""


@dataclass(frozen=True)
class AnnealingResult:
    """Where annealing ended: the best point `x` (n,) seen, the `cost` there, and the `evaluations` spent.

    `converged` when the cooling schedule ran to its end, not when a budget cut it short.
    """

    x: FloatArray
    cost: float
    evaluations: int
    converged: bool


def simulated_annealing(
    objective: Callable[[FloatArray], float],
    start: ArrayLike,
    lower: ArrayLike,
    upper: ArrayLike,
    *,
    seed: int | np.random.Generator = 0,
    evaluations: int = 2000,
    initial_step: ArrayLike | None = None,
    meter: Meter | None = None,
) -> AnnealingResult:
    """Return the minimum of `objective` over a box, by Corana-type simulated annealing [1]_.

    One coordinate moves at a time; a worse cost is accepted with probability exp(-(c' - c) / T). Step lengths
    follow the acceptance rate; T falls geometrically with the evaluations spent.

    Parameters
    ----------
    objective : callable
        Maps (n,) float64 to a cost; a cost that is not finite is never accepted.
    start, lower, upper : (n,) array_like
        Start point and box; proposals outside are reflected. ValueError when they do not agree.
    seed : int or numpy.random.Generator
    evaluations : int
        After which it stops (the meter's budget may stop it earlier).
    initial_step : (n,) array_like, optional
        First step lengths; a quarter of the box when omitted.
    meter : Meter, optional
        Counts evaluations, records every improvement and ends the run with its budget.

    .. [1] A. Corana et al., "Minimizing multimodal functions of continuous variables with the
       'simulated annealing' algorithm", ACM TOMS 13(3), 1987.

    >>> result = simulated_annealing(lambda x: float(np.sum((x - 0.3) ** 2)), [0, 0], [-1, -1], [1, 1])
    >>> bool(np.abs(result.x - 0.3).max() < 0.02)
    True
    """
    low, high = np.asarray(lower, float), np.asarray(upper, float)
    x = np.clip(np.asarray(start, float), low, high)
    if not (x.shape == low.shape == high.shape and np.all(low <= high)):
        raise ValueError(f"start {x.shape}, lower {low.shape}, upper {high.shape} must agree, lower <= upper")
    rng = np.random.default_rng(seed)
    step = (high - low) / 4 if initial_step is None else np.asarray(initial_step, float).copy()
    meter = meter if meter is not None else Meter("annealing", "cost")

    def evaluate(point: FloatArray) -> float:
        meter.count()
        value = float(objective(point))
        return value if np.isfinite(value) else np.inf

    cost = evaluate(x)
    best_x = x.copy()
    best_cost = cost
    used = 1
    # The first temperature, as a part of the spread of the first costs.
    seen = [cost]
    scale = 0.0
    hot = 0.3
    # Of each coordinate, before its step length is adapted.
    accepted = np.zeros(x.size)
    moves = 10
    while used < evaluations and not meter.exhausted:
        k = (used - 1) % x.size
        trial = x.copy()
        proposed = x[k] + step[k] * rng.uniform(-1, 1)
        mirrored = 2 * low[k] - proposed if proposed < low[k] else 2 * high[k] - proposed
        trial[k] = np.clip(proposed if low[k] <= proposed <= high[k] else mirrored, low[k], high[k])
        trial_cost = evaluate(trial)
        used += 1
        if len(seen) < 20:
            seen.append(trial_cost)
            finite = [c for c in seen if np.isfinite(c)]
            scale = float(np.std(finite)) if len(finite) > 1 else 0.0
        temperature = scale * hot * (_FINAL_TEMPERATURE / hot) ** (used / evaluations)
        worse = trial_cost - cost
        if worse <= 0 or (temperature > 0 and rng.random() < np.exp(-worse / temperature)):
            x, cost = trial, trial_cost
            accepted[k] += 1
            if cost < best_cost:
                best_x, best_cost = x.copy(), cost
                meter.record(best_cost)
        if (used - 1) % (moves * x.size) == 0:
            step = np.clip(step * np.exp(accepted / moves - _ACCEPTANCE), 1e-9, high - low)
            accepted[:] = 0
    return AnnealingResult(best_x, best_cost, used, converged=used >= evaluations)
