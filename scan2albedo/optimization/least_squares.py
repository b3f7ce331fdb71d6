"""Damped least squares (Levenberg-Marquardt) over any state that a step can move."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Generic, Protocol, Self, TypeVar

import numpy as np

from scan2albedo.core import Meter
from scan2albedo.core.arrays import FloatArray

SMALLEST_DIAGONAL = 1e-9
"""As a part of the largest: damps parameters that the cost does not depend on, so that they stay."""


@dataclass(frozen=True)
class NormalEquations:
    """The quadratic model cost(d) = cost + gradient . d + d . matrix d / 2 of a step d (P,), within bounds.

    `matrix` (P, P) is the Gauss-Newton matrix J^T W J, `gradient` (P,) J^T W r of the residuals r; a common
    factor does not matter. A step stays between `lower` (P,) <= 0 and `upper` (P,) >= 0, when given.
    """

    matrix: FloatArray
    gradient: FloatArray
    lower: FloatArray | None = None
    upper: FloatArray | None = None


class LeastSquaresPoint(Protocol):
    """A state with its cost: what `minimize` walks over.

    The point counts its own evaluation in the meter. A robust loss may settle new weights in
    `normal_equations`, after which `cost` is read; what `moved` returns is under the same weights.
    """

    @property
    def cost(self) -> float:
        """What is minimised; NaN or infinite where the state is not possible."""

    def normal_equations(self) -> NormalEquations:
        """Return the quadratic model around the state; called once, and only for the best state so far."""

    def moved(self, step: FloatArray) -> Self:
        """Return the state that a step (P,) leads to, evaluated."""


Point = TypeVar("Point", bound=LeastSquaresPoint)


@dataclass(frozen=True)
class Damping:
    """How the damping, a factor of the matrix's diagonal, follows the success of the steps.

    It starts with `first`, is multiplied by `decrease` after a step that lowered the cost, by `increase`
    after one that did not, and is at least `least` and `after_failure`; beyond `largest` is a minimum.
    """

    first: float = 1e-3
    decrease: float = 0.2
    increase: float = 8.0
    least: float = 1e-9
    after_failure: float = 0.0
    largest: float = 1e10


@dataclass(frozen=True)
class Descent(Generic[Point]):
    """Where `minimize` ended: the `best` point, the start where nothing better was found.

    `converged` at a minimum within the tolerances, not when trials, steps or budget ended first. `steps`
    lowered the cost; another run may go on with `damping`.
    """

    best: Point
    converged: bool
    steps: int
    damping: float


def minimize(
    start: Point,
    *,
    trials: int | None = None,
    steps: int | None = None,
    tolerance: float = 0.0,
    flat_steps: int = 1,
    step_tolerance: float = 0.0,
    damping: Damping = Damping(),
    meter: Meter | None = None,
    on_better: Callable[[Point], None] | None = None,
) -> Descent[Point]:
    """Return where damped Gauss-Newton steps [1]_ lead, (matrix + damping diag(matrix)) d = -gradient each.

    A step is taken when it lowers the cost; else it is tried again with more damping.

    Parameters
    ----------
    start : LeastSquaresPoint
        Returned as it is when its cost is not finite.
    trials, steps : int, optional
        Most steps tried, and most of them that lower the cost.
    tolerance, flat_steps, step_tolerance : float, int, float
        Converged after that many steps in a row that each lower the cost by less than this part, or a short
        step.
    damping : Damping
    meter : Meter, optional
        Its budget ends the descent with the best so far.
    on_better : callable, optional
        Gets the start and every better point.

    .. [1] D. Marquardt, "An algorithm for least-squares estimation of nonlinear parameters", J. SIAM 11(2),
       1963.
    """
    best = start
    strength = damping.first
    taken = 0
    flat = 0
    if not math.isfinite(start.cost):
        return Descent(start, False, 0, strength)
    if on_better is not None:
        on_better(start)
    tried = 0
    model = None
    while (trials is None or tried < trials) and (steps is None or taken < steps):
        if meter is not None and meter.exhausted:
            break
        model = best.normal_equations() if model is None else model
        step = damped_step(model, strength)
        trial, before = best.moved(step), best.cost
        tried += 1
        small = float(np.linalg.norm(step)) <= step_tolerance
        if trial.cost < before:
            fall = before - trial.cost
            best, model, taken = trial, None, taken + 1
            strength = max(strength * damping.decrease, damping.least)
            if on_better is not None:
                on_better(best)
            flat = flat + 1 if fall < tolerance * abs(before) else 0
            small = small or flat == flat_steps
        else:
            strength = max(strength * damping.increase, damping.after_failure)
        if small or strength > damping.largest:
            return Descent(best, True, taken, strength)
    return Descent(best, False, taken, strength)


def damped_step(model: NormalEquations, damping: float) -> FloatArray:
    """Return the step (P,) of `model` with `damping` times its matrix's diagonal added, within its bounds.

    Parameters that would leave these at once stay.
    """
    free = np.ones(len(model.gradient), bool)
    if model.lower is not None:
        free &= (model.lower < 0) | (model.gradient <= 0)
    if model.upper is not None:
        free &= (model.upper > 0) | (model.gradient >= 0)
    step = np.zeros(len(free))
    if not free.any():
        return step
    damped = model.matrix[np.ix_(free, free)]
    diagonal = np.diag(damped)
    diagonal = np.maximum(diagonal, SMALLEST_DIAGONAL * max(float(diagonal.max()), 1e-30))
    damped.flat[:: len(damped) + 1] += damping * diagonal
    try:
        step[free] = -np.linalg.solve(damped, model.gradient[free])
    except np.linalg.LinAlgError:  # damping below the rounding of a singular matrix
        step[free] = -np.linalg.lstsq(damped, model.gradient[free], rcond=None)[0]
    if model.lower is not None or model.upper is not None:
        step = np.clip(step, model.lower, model.upper)
    return step


@dataclass(frozen=True)
class LocalTerm:
    """A data term around a state, as a function of R residuals that are linear in the step (P,)."""

    jacobian: Any
    """(R, P)."""
    slope: FloatArray
    curvature: FloatArray
    """`slope`, `curvature`: (R,): first and second derivatives of the term by each residual."""


def map_equations(terms: Iterable[LocalTerm], prior: FloatArray, numbers: FloatArray) -> NormalEquations:
    """Return the quadratic model of terms, one or more, and of half of prior * x^2, summed.

    `prior` and `numbers` x, of which a step moves the first P, are (X,): 0 for numbers without a prior.
    """
    matrix, gradient = np.zeros((1, 1)), np.zeros(1)
    for term in terms:
        scaled = term.jacobian * np.sqrt(term.curvature)[:, None]
        matrix, gradient = matrix + scaled.T @ scaled, gradient + term.jacobian.T @ term.slope
    tight = prior[: len(gradient)]
    return NormalEquations(matrix + np.diag(tight), gradient + tight * numbers[: len(gradient)])
