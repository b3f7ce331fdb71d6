"""The most probable state under data terms and a Gaussian prior of coefficients, for fits to one image."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from scan2albedo.core import Meter
from scan2albedo.core.arrays import FloatArray
from scan2albedo.optimization.least_squares import Damping, Descent, NormalEquations, minimize

State = TypeVar("State")


@dataclass(frozen=True)
class LocalTerm:
    """A data term around a state, as a function of R residuals that are linear in the step (P,)."""

    jacobian: Any
    """(R, P)."""
    slope: FloatArray
    curvature: FloatArray
    """`slope`, `curvature`: (R,): first and second derivatives of the term by each residual."""


class MapObjective(Protocol[State]):
    """Data terms, and the prior of a state's numbers x: half of prior * x^2, summed."""

    @property
    def prior(self) -> FloatArray:
        """(X,) precisions; 0 for numbers without a prior."""

    def numbers(self, state: State) -> FloatArray:
        """Return x (X,), of which a step moves the first P."""

    def value(self, state: State) -> float:
        """Return the data terms; inf where one is not defined."""

    def local_terms(self, state: State) -> Iterable[LocalTerm]:
        """Return the data terms around a state; one or more."""

    def moved(self, state: State, step: FloatArray) -> State:
        """Return the state a step (P,) on."""


@dataclass(frozen=True)
class MapPoint(Generic[State]):
    """An objective at a state, for `minimize`."""

    objective: MapObjective[State]
    state: State
    cost: float
    meter: Meter

    @classmethod
    def evaluate(cls, objective: MapObjective[State], state: State, meter: Meter) -> MapPoint[State]:
        """Return the point of a state, counted in the meter."""
        meter.count()
        cost = objective.value(state) + 0.5 * float(objective.prior @ objective.numbers(state) ** 2)
        return cls(objective, state, cost, meter)

    def normal_equations(self) -> NormalEquations:
        """Return the Gauss-Newton matrix and the gradient."""
        matrix, gradient = np.zeros((1, 1)), np.zeros(1)
        for term in self.objective.local_terms(self.state):
            scaled = term.jacobian * np.sqrt(term.curvature)[:, None]
            matrix, gradient = matrix + scaled.T @ scaled, gradient + term.jacobian.T @ term.slope
        prior = self.objective.prior[: len(gradient)]
        gradient = gradient + prior * self.objective.numbers(self.state)[: len(gradient)]
        return NormalEquations(matrix + np.diag(prior), gradient)

    def moved(self, step: FloatArray) -> MapPoint[State]:
        """Return the point a step on."""
        return self.evaluate(self.objective, self.objective.moved(self.state, step), self.meter)


def most_probable(
    start: MapPoint[State], *, steps: int, tolerance: float, damping: Damping = Damping()
) -> Descent[MapPoint[State]]:
    """Return where Levenberg-Marquardt leads, until the cost falls by less than `tolerance` three times."""
    return minimize(
        start,
        steps=steps,
        tolerance=tolerance,
        flat_steps=3,
        damping=damping,
        meter=start.meter,
        on_better=lambda point: point.meter.record(point.cost),
    )
