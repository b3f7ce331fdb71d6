"""Fronts and knees of known points."""

import numpy as np
import pytest
from bench.pareto import pareto_front


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
