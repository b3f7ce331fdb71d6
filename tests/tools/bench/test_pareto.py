"""Fronts and knees of known points."""

import numpy as np
import pytest
from bench.pareto import knee, pareto_front


def test_front_is_that_of_the_definition_on_random_points():
    points = np.random.default_rng(0).integers(0, 12, (60, 2))
    apart = points[:, None] - points
    dominated = ((apart >= 0).all(2) & (apart > 0).any(2)).any(1)
    found = points[pareto_front(*points.T)]
    assert sorted(found.tolist()) == np.unique(points[~dominated], axis=0).tolist()


def test_front_leaves_out_what_failed():
    assert pareto_front([1, 2, np.nan], [np.nan, 3, 1]).tolist() == [False, True, False]


def test_front_refuses_other_shapes():
    with pytest.raises(ValueError, match=r"\(2,\).*\(3,\)"):
        pareto_front([1, 2], [1, 2, 3])


@pytest.mark.parametrize(
    ("cost", "error", "expected"),
    [
        ([0.8, 0.1, 3.2, 0.2, 1.6, 0.4], [1.0, 64, 0.95, 16, 0.97, 4], 0),
        ([1, 2, 4, 8], [9, 2, 1.5, 1.4], 1),
        ([1000, 2000, 4000, 8000], [63, 14, 10.5, 9.8], 1),  # the same in other units
        ([1, 2, 4], [1, 0.5, 0.25], 2),  # a power law ends in its knee
        ([1, 2], [3, 4], 0),
        ([], [], None),
        ([np.nan], [1.0], None),
        ([1, 2, 50], [5, 0, 0], 1),
    ],
)
def test_knee_is_the_bend_of_the_front(cost, error, expected):
    assert knee(cost, error) == expected
