"""Simulated annealing: finds minima among many, deterministically, within its budget."""

import numpy as np
import pytest

from scan2albedo.core import Budget, Meter
from scan2albedo.optimization.annealing import simulated_annealing


def rastrigin(x):
    return float(10 * x.size + np.sum(x**2 - 10 * np.cos(2 * np.pi * x)))


BOX = [-5.0, -5.0], [5.0, 5.0]


def test_leaves_local_minima():
    # A descent from the start ends in the minimum near (4, 4), at a cost of 32.
    costs = [
        simulated_annealing(rastrigin, [4, 4], *BOX, seed=seed, evaluations=4000).cost for seed in range(5)
    ]
    assert np.median(costs) < 1.1
    assert max(costs) < 8


def test_same_seed_same_bits_other_seed_other_bits():
    first, again, other = (simulated_annealing(rastrigin, [1, 2], *BOX, seed=seed) for seed in (4, 4, 5))
    assert np.array_equal(first.x, again.x)
    assert first.cost == again.cost
    assert not np.array_equal(first.x, other.x)


def test_stays_in_the_box():
    seen = []

    def objective(x):
        seen.append(np.abs(x).max())
        return float(x.sum())

    result = simulated_annealing(objective, [0, 0], *BOX)
    assert max(seen) <= 5
    assert result.x == pytest.approx([-5, -5], abs=0.05)


def test_budget_ends_it_with_the_best_so_far():
    costs = []

    def objective(x):
        costs.append(rastrigin(x))
        return costs[-1]

    meter = Meter("annealing", "cost", Budget(evaluations=40))
    result = simulated_annealing(objective, [4, 4], *BOX, meter=meter)
    assert len(costs) == 40
    assert result.cost == min(costs)
    assert not result.converged
    assert simulated_annealing(objective, [4, 4], *BOX).converged


def test_costs_that_are_not_finite_are_never_accepted():
    result = simulated_annealing(lambda x: np.nan if x[0] < 0 else x[0] + abs(x[1]), [1, 1], *BOX, seed=1)
    assert result.x[0] >= 0
    assert np.isfinite(result.cost)


def test_a_start_outside_is_clipped_and_a_bad_box_refused():
    assert np.isfinite(simulated_annealing(rastrigin, [99, 0], *BOX).cost)
    with pytest.raises(ValueError, match="lower <= upper"):
        simulated_annealing(rastrigin, [0, 0], BOX[1], BOX[0])


def test_a_start_where_the_cost_is_not_a_number_is_left():
    result = simulated_annealing(
        lambda x: np.nan if x[0] > 0.5 else (x[0] + 0.2) ** 2, [0.9], [-1], [1], evaluations=500
    )
    assert abs(result.x[0] + 0.2) < 0.05
    assert np.isfinite(result.cost)
