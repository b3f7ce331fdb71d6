"""The paper's objective, compiled, against a loop over blocks; the search by it."""

import numpy as np
import pytest

from scan2albedo.albedo import EstimateOptions, estimate_albedo
from scan2albedo.albedo.paper_search import albedo_deviation
from scan2albedo.core import Budget
from scan2albedo.synthetic import face, light_at


def test_albedo_deviation_equals_a_loop_over_blocks():
    rng = np.random.default_rng(0)
    value, weight = rng.uniform(0.1, 1, 400), rng.uniform(0, 1, 400)
    light, specular = rng.uniform(1, 4, 400), rng.uniform(0, 0.1, 400)
    blocks = np.stack([rng.integers(0, 8, 400), rng.integers(8, 13, 400)]).astype(np.int32)
    albedo = (value - specular) / light
    cost = 0.0
    for partition in blocks:
        for block in np.unique(partition):
            b = partition == block
            cost += np.sum(weight[b] * np.abs(albedo[b] - np.average(albedo[b], weights=weight[b])))
    expected = cost / (2 * np.sum(weight * albedo))
    assert albedo_deviation(value, weight, light, specular, blocks, 13) == pytest.approx(expected, rel=1e-12)


def test_the_search_finds_what_it_always_found():
    """It is there to be compared with: what changes elsewhere does not change it."""
    image = face(0, size=64, lights=[light_at(30, 10)]).image
    options = EstimateOptions(objective="albedo-deviation", sizes=(32, 64, 128))
    estimate = estimate_albedo(image, 1, budget=Budget(evaluations=1000), options=options)
    assert estimate.residual == pytest.approx(0.05056170510936018, rel=1e-9)
    assert estimate.iterations == 1000
