"""The compiled objectives against loops over blocks; what they can and cannot tell."""

import numpy as np
import pytest

from scan2albedo.albedo.objective import albedo_deviation, block_residual


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


def test_block_residual_equals_a_loop():
    value, weight, light, specular, blocks, count = _problem()
    cost = 0.0
    for b in _blocks(blocks):
        v, w, i, s = value[b], weight[b], light[b], specular[b]
        albedo = np.sum(w * (v - s) * i) / np.sum(w * i**2)
        cost += np.sum(w * np.abs(v - s - i * albedo))
    expected = cost / (2 * np.sum(weight * value))
    assert block_residual(value, weight, light, specular, blocks, count) == pytest.approx(expected, rel=1e-12)


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


@pytest.mark.parametrize("objective", [block_residual, albedo_deviation])
def test_true_light_leaves_nothing_of_block_constant_albedo(objective):
    _, weight, light, specular, _, _ = _problem()
    blocks = np.repeat(np.arange(8, dtype=np.int32), 50)[None]
    value = np.linspace(0.2, 0.9, 8)[blocks[0]] * light + specular
    assert objective(value, weight, light, specular, blocks, 8) < 1e-12
    assert objective(value, weight, light**0.9, specular, blocks, 8) > 0.01


@pytest.mark.parametrize("objective", [block_residual, albedo_deviation])
def test_the_global_scale_of_light_and_exposure_cannot_be_seen(objective):
    value, weight, light, specular, blocks, count = _problem()
    cost = objective(value, weight, light, specular, blocks, count)
    assert objective(3 * value, weight, 7 * light, 3 * specular, blocks, count) == pytest.approx(cost)


def test_texels_without_weight_have_no_vote():
    value, weight, light, specular, blocks, count = _problem()
    weight[::3] = 0
    cost = block_residual(value, weight, light, specular, blocks, count)
    value[::3] = 50
    assert block_residual(value, weight, light, specular, blocks, count) == pytest.approx(cost)


def test_a_highlight_brighter_than_the_texel_costs_its_excess_again():
    value, weight, light, specular, blocks, count = _problem()
    plain = block_residual(value, weight, light, specular, blocks, count)
    specular[5] = value[5]
    edge = block_residual(value, weight, light, specular, blocks, count)
    specular[5] += 0.2
    beyond = block_residual(value, weight, light, specular, blocks, count)
    per_unit = weight[5] / np.sum(weight * value)
    assert abs(edge - plain) < per_unit
    assert beyond - edge > 3 * 0.2 * per_unit
