"""Damped least squares for the light: few evaluations, each with derivatives."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from scan2albedo.albedo.light_model import LightModel
from scan2albedo.albedo.problem import Solution
from scan2albedo.albedo.residual_problem import Linearization, ResidualProblem

FloatArray = NDArray[np.float64]

_DAMPING, _EASE, _BRAKE, _STUCK = 1e-3, 0.2, 8.0, 1e4
"""First damping (of the matrix's diagonal), its factors after a better and a worse step, where to stop."""
_CAUTION = 0.1
"""Damping of the one step by which starts are ranked: far from an optimum the model is hardly linear."""
_LONGEST = 4.0
"""Longest step as a multiple of the model's first steps."""
_SETTLED = 1e-5
"""Part of the cost below which an improvement ends the descent."""


def descend(problem: ResidualProblem, model: LightModel, x: FloatArray, iterations: int) -> Solution:
    """Return a local minimum near x within the bounds, after `iterations` evaluations at most.

    x itself with an infinite cost where the budget has already ended.

    Parameters
    ----------
    problem : ResidualProblem
    model : LightModel
    x : (P,) float64
    iterations : int

    References
    ----------
    .. [1] D. Marquardt, "An algorithm for least-squares estimation of nonlinear parameters", J. SIAM 11(2),
       1963.
    """
    lower, upper = model.bounds
    x = np.clip(x, lower, upper)
    if problem.meter.exhausted:
        return Solution(model, x, math.inf)
    here, damping = problem.linearize(model, x), _DAMPING
    for _ in range(iterations - 1):
        if problem.meter.exhausted:
            break
        trial = np.clip(x + _step(here, model, x, damping), lower, upper)
        there = problem.linearize(model, trial)
        if there.cost < here.cost:
            gained = 1 - there.cost / here.cost
            x, here, damping = trial, there, max(damping * _EASE, 1e-7)
            if gained < _SETTLED:
                break
        else:
            damping = max(damping * _BRAKE, 1e-4)
            if damping > _STUCK:
                break
    return Solution(model, x, here.cost)


def promise(problem: ResidualProblem, model: LightModel, x: FloatArray) -> tuple[float, FloatArray]:
    """Return the cost that one damped step from x promises, and where it leads: ranks starts cheaply."""
    here = problem.linearize(model, x)
    step = _step(here, model, x, _CAUTION)
    gain = 2 * float(step @ here.gradient) - float(step @ here.matrix @ step)
    return here.cost - 0.5 * max(gain, 0.0), np.clip(x + step, *model.bounds)


def _step(here: Linearization, model: LightModel, x: FloatArray, damping: float) -> FloatArray:
    """Return the damped step; parameters that would leave their bounds stay."""
    lower, upper = model.bounds
    gradient = here.gradient
    free = ~(((x <= lower) & (gradient < 0)) | ((x >= upper) & (gradient > 0)))
    step = np.zeros_like(x)
    if not free.any():
        return step
    matrix = here.matrix[np.ix_(free, free)]
    diagonal = np.diag(matrix)
    diagonal = np.maximum(diagonal, 1e-9 * max(float(diagonal.max()), 1e-30))
    step[free] = np.linalg.solve(matrix + damping * np.diag(diagonal), gradient[free])
    longest = _LONGEST * model.steps()
    return np.clip(step, -longest, longest)
