"""Damped least squares over a frame's state."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from scan2albedo.core import Meter
from scan2albedo.eyeglasses.on_face.frame_motion import FrameState
from scan2albedo.eyeglasses.on_face.registration_terms import Linearization

_DAMPING, _EASE, _BRAKE, _STUCK = 1e-3, 0.2, 8.0, 1e6
"""First damping (of the matrix's diagonal), its factors after a better and a worse step, where to stop."""
_FLOOR = 1e-9
"""Least diagonal entry, as a part of the largest: parameters that nothing depends on stay."""
ENOUGH = 1e-5
"""Part of the cost below which an improvement ends a descent."""


@dataclass(frozen=True)
class Descent:
    """Where a descent ended."""

    state: FrameState
    at: Linearization
    converged: bool


def descend(
    linearize: Callable[[FrameState], Linearization],
    state: FrameState,
    meter: Meter,
    *,
    steps: int,
    enough: float,
    error: Callable[[Linearization], float],
) -> Descent:
    """Return the best state that Levenberg-Marquardt steps from `state` reach.

    Parameters
    ----------
    linearize : callable
        The objective at a state.
    state : FrameState
    meter : Meter
        Counts evaluations, gets `error` of every improvement, ends the descent with its budget.
    steps : int
    enough : float
        Part of the cost below which an improvement ends the descent.
    error : callable
        What the trace shows.

    References
    ----------
    .. [1] D. Marquardt, "An algorithm for least-squares estimation of nonlinear parameters", J. SIAM 11(2),
       1963.
    """
    here, damping = linearize(state), _DAMPING
    meter.count()
    meter.record(error(here))
    for _ in range(steps):
        if meter.exhausted:
            return Descent(state, here, False)
        diagonal = np.diag(here.matrix)
        diagonal = np.maximum(diagonal, _FLOOR * max(float(diagonal.max()), 1e-30))
        step = -np.asarray(np.linalg.solve(here.matrix + damping * np.diag(diagonal), here.gradient))
        trial = state.moved(step)
        there = linearize(trial)
        meter.count()
        if there.cost < here.cost:
            gained = 1 - there.cost / here.cost
            state, here, damping = trial, there, max(damping * _EASE, 1e-9)
            meter.record(error(here))
            if gained < enough:
                return Descent(state, here, True)
        else:
            damping *= _BRAKE
            if damping > _STUCK:
                return Descent(state, here, True)
    return Descent(state, here, False)
