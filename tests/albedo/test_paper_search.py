"""The paper's objective, compiled, against a loop over blocks; what it can and cannot tell."""

import numpy as np
import pytest

from scan2albedo.albedo import EstimateOptions, estimate_albedo
from scan2albedo.albedo.paper_search import albedo_deviation
from scan2albedo.core import Budget
from scan2albedo.synthetic import face, light_at


def _problem(count=400, seed=0):
    rng = np.random.default_rng(seed)
    value, weight = rng.uniform(0.1, 1, count), rng.uniform(0, 1, count)
    light, specular = rng.uniform(1, 4, count), rng.uniform(0, 0.1, count)
    blocks = np.stack([rng.integers(0, 8, count), rng.integers(8, 13, count)]).astype(np.int32)
    return value, weight, light, specular, blocks, 13


def _blocks(blocks):
    for partition in blocks:
        for block in np.unique(partition):
            yield partition == block


def test_albedo_deviation_equals_a_loop():
    value, weight, light, specular, blocks, count = _problem()
    albedo = np.maximum(value - specular, 0) / light
    cost = sum(
        np.sum(weight[b] * np.abs(albedo[b] - np.average(albedo[b], weights=weight[b])))
        for b in _blocks(blocks)
    )
    expected = cost / (2 * np.sum(weight * albedo))
    assert albedo_deviation(value, weight, light, specular, blocks, count) == pytest.approx(
        expected, rel=1e-12
    )


def test_true_light_leaves_nothing_of_block_constant_albedo():
    _, weight, light, specular, _, _ = _problem()
    blocks = np.repeat(np.arange(8, dtype=np.int32), 50)[None]
    value = np.linspace(0.2, 0.9, 8)[blocks[0]] * light + specular
    assert albedo_deviation(value, weight, light, specular, blocks, 8) < 1e-12
    assert albedo_deviation(value, weight, light**0.9, specular, blocks, 8) > 0.01


def test_the_global_scale_of_light_and_exposure_cannot_be_seen():
    value, weight, light, specular, blocks, count = _problem()
    cost = albedo_deviation(value, weight, light, specular, blocks, count)
    assert albedo_deviation(3 * value, weight, 7 * light, 3 * specular, blocks, count) == pytest.approx(cost)


def test_the_search_finds_what_it_always_found():
    """It is there to be compared with: what changes elsewhere does not change it."""
    image = face(0, size=64, lights=[light_at(30, 10)]).image
    options = EstimateOptions(objective="albedo-deviation", sizes=(32, 64, 128))
    estimate = estimate_albedo(image, 1, budget=Budget(evaluations=1000), options=options)
    assert estimate.residual == pytest.approx(0.05056170510936018, rel=1e-9)
    assert estimate.iterations == 1000
