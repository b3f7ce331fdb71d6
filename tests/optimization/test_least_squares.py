"""Damped least squares: closed forms, bounds, budgets and costs that are not numbers."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from scan2albedo.core import Budget, Meter
from scan2albedo.optimization.least_squares import Damping, NormalEquations, damped_step, minimize


@dataclass
class Residuals:
    """Half the sum of weighted squares of `residuals(x)`, a pair of r (R,) and J (R, P)."""

    residuals: Any
    x: np.ndarray
    box: tuple[Any, Any] = (None, None)
    meter: Meter | None = None

    def __post_init__(self):
        if self.meter is not None:
            self.meter.count()

    @property
    def cost(self):
        return 0.5 * float(np.sum(self.residuals(self.x)[0] ** 2))

    def normal_equations(self):
        r, jacobian = self.residuals(self.x)
        lower, upper = (None if bound is None else bound - self.x for bound in self.box)
        return NormalEquations(jacobian.T @ jacobian, jacobian.T @ r, lower, upper)

    def moved(self, step):
        return Residuals(self.residuals, self.x + step, self.box, self.meter)


def linear(x):
    matrix = np.array([[2.0, 1.0], [1.0, 3.0], [0.5, -1.0]])
    return matrix @ x - matrix @ [1.0, -2.0], matrix


def rosenbrock(x):
    return np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]]), np.array([[-20 * x[0], 10.0], [-1.0, 0.0]])


def test_a_linear_problem_takes_one_step():
    found = minimize(Residuals(linear, np.zeros(2)), steps=1, damping=Damping(first=1e-14))
    assert np.abs(found.best.x - [1, -2]).max() < 1e-12
    assert found.steps == 1


def test_finds_the_minimum_of_rosenbrock():
    found = minimize(Residuals(rosenbrock, np.array([-1.2, 1.0])), trials=100)
    assert np.abs(found.best.x - 1).max() < 1e-9
    assert found.steps < 40


def test_a_minimum_ends_the_descent_by_any_criterion():
    start = Residuals(rosenbrock, np.array([1.1, 1.2]))
    for stop in ({"tolerance": 1e-6}, {"step_tolerance": 1e-8}, {}):
        found = minimize(start, trials=200, **stop)
        assert found.converged, stop
        assert np.abs(found.best.x - 1).max() < 1e-6


def test_asks_for_several_flat_steps():
    def slow(x):
        return x**2, np.diag(2 * x)  # Gauss-Newton halves x: the cost falls by 15 in 16

    start = Residuals(slow, np.array([1.0, 1.0]))
    ends = [minimize(start, tolerance=0.99, flat_steps=count).steps for count in (1, 3)]
    assert ends == [1, 3]


def test_active_bounds_hold_and_the_others_reach_their_minimum():
    box = np.array([-5.0, -1.5]), np.array([5.0, 5.0])
    found = minimize(Residuals(linear, np.zeros(2), box), trials=50, tolerance=1e-14)
    assert found.best.x[1] == -1.5
    # With y held 0.5 off, x solves the normal equation of its own column a: a.a dx = -a.b dy.
    assert found.best.x[0] == pytest.approx(1 - 4.5 / 5.25 * 0.5, abs=1e-6)


NOTHING = np.zeros(2)
AGAINST_BOTH = np.eye(2), np.array([1.0, -1.0])


@pytest.mark.parametrize(
    ("model", "damping", "step"),
    [
        (NormalEquations(*AGAINST_BOTH, NOTHING, NOTHING), 0.1, NOTHING),
        (NormalEquations(*AGAINST_BOTH, NOTHING, np.array([9.0, 0.5])), 0.1, [0, 0.5]),
        (NormalEquations(np.zeros((2, 2)), NOTHING), 1e-3, NOTHING),
        (NormalEquations(np.ones((2, 2)), np.array([-1.0, -1.0])), 0.0, [0.5, 0.5]),
    ],
    ids=["both at their bounds", "one at its bound", "flat", "singular: the shortest"],
)
def test_a_step_of_two_parameters(model, damping, step):
    np.testing.assert_allclose(damped_step(model, damping), step)


def test_what_the_cost_does_not_depend_on_stays():
    model = NormalEquations(np.diag([1.0, 0.0]), np.array([1.0, 0.0]))
    assert damped_step(model, 1e-3)[1] == 0


def test_the_budget_ends_with_the_best_so_far():
    meter = Meter("test", "cost", Budget(evaluations=6))
    seen = []
    start = Residuals(rosenbrock, np.array([-1.2, 1.0]), meter=meter)
    found = minimize(start, meter=meter, on_better=lambda point: seen.append(point.cost))
    assert not found.converged
    assert meter.evaluations == 6
    assert found.best.cost == min(seen) < seen[0]
    assert seen == sorted(seen, reverse=True)


def test_a_budget_that_has_ended_leaves_the_start():
    meter = Meter("test", "cost", Budget(evaluations=1))
    start = Residuals(rosenbrock, np.array([-1.2, 1.0]), meter=meter)
    found = minimize(start, meter=meter)
    assert found.best is start
    assert not found.converged
    assert (found.steps, meter.evaluations) == (0, 1)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_costs_that_are_no_numbers_are_not_accepted(bad):
    def broken(x):
        r, jacobian = linear(x)
        return (r if x[0] < 0.6 else np.full(3, bad)), jacobian

    found = minimize(Residuals(broken, np.zeros(2)), trials=60)
    assert np.isfinite(found.best.cost)
    assert 0.3 < found.best.x[0] < 0.6
    start = Residuals(broken, np.ones(2))
    assert minimize(start, trials=9).best is start


def test_every_taken_step_lowers_the_cost_where_newton_overshoots():
    def arctan(x):
        return np.arctan(x), np.diag(1 / (1 + x**2))

    found = minimize(Residuals(arctan, np.array([30.0])), trials=100, tolerance=1e-9)
    assert abs(found.best.x[0]) < 1e-6


def test_weights_settled_at_a_step_hold_for_both_costs_it_compares():
    class Reweighted(Residuals):
        """A location under weights that only `normal_equations` renews."""

        weights = np.ones(3)

        @property
        def cost(self):
            return 0.5 * float(self.weights @ self.off() ** 2)

        def off(self):
            return self.x - [0.0, 0.0, 9.0]

        def normal_equations(self):
            self.weights = 1 / np.hypot(self.off(), 0.1)
            return NormalEquations(self.weights.sum()[None, None], (self.weights @ self.off())[None])

        def moved(self, step):
            point = Reweighted(None, self.x + step)
            point.weights = self.weights
            return point

    found = minimize(Reweighted(None, np.array([3.0])), trials=100, tolerance=1e-12)
    assert abs(found.best.x[0]) < 0.06  # the median, not the mean
