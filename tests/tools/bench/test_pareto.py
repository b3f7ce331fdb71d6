"""Fronts and knees of known points."""

import numpy as np
import pytest
from bench.pareto import knee, pareto_front


def test_front_holds_what_nothing_dominates():
    cost, error = [1, 2, 2, 3, 4, 5], [10, 8, 4, 5, 4, 1]
    assert pareto_front(cost, error).tolist() == [True, False, True, False, False, True]


def test_front_is_that_of_the_definition_on_random_points():
    rng = np.random.default_rng(0)
    points = rng.integers(0, 12, (60, 2)).astype(float)
    cost, error = points.T
    no_worse = (cost[:, None] >= cost) & (error[:, None] >= error)
    worse = no_worse & ((cost[:, None] > cost) | (error[:, None] > error))
    undominated = ~worse.any(1)
    front = pareto_front(cost, error)
    assert {tuple(p) for p in points[front]} == {tuple(p) for p in points[undominated]}
    assert len({tuple(p) for p in points[front]}) == front.sum()


def test_front_leaves_out_what_failed():
    assert pareto_front([1, 2, np.nan], [np.nan, 3, 1]).tolist() == [False, True, False]


def test_front_refuses_other_shapes():
    with pytest.raises(ValueError, match=r"\(2,\).*\(3,\)"):
        pareto_front([1, 2], [1, 2, 3])


def test_knee_is_the_bend_of_a_bent_curve():
    cost = np.array([0.1, 0.2, 0.4, 0.8, 1.6, 3.2])
    error = np.array([64.0, 16.0, 4.0, 1.0, 0.97, 0.95])
    order = np.array([3, 0, 5, 1, 4, 2])
    assert order[knee(cost[order], error[order])] == 3


def test_knee_does_not_depend_on_units():
    cost, error = np.array([1, 2, 4, 8.0]), np.array([9, 2, 1.5, 1.4])
    assert knee(1000 * cost, error / 7) == knee(cost, error) == 1


def test_knee_of_a_power_law_is_its_end():
    cost = np.array([1.0, 2.0, 4.0])
    assert knee(cost, 1 / cost) == 2


def test_knee_of_one_point_and_of_none():
    assert knee([1.0, 2.0], [3.0, 4.0]) == 0
    assert knee([], []) is None
    assert knee([np.nan], [1.0]) is None


def test_knee_takes_an_error_of_zero():
    assert knee([1.0, 2.0, 50.0], [5.0, 0.0, 0.0]) == 1
