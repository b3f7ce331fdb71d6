"""Priors of the light: their derivatives, and the log odds of a part against the closed form."""

import math

import numpy as np
import pytest

from scan2albedo.albedo import EstimateOptions
from scan2albedo.albedo.light_parameters import FILL, LightModel
from scan2albedo.albedo.light_priors import light_prior, parts_steps

VIEW = (0.0, 0.0, 1.0)
PARTS = ("near", "rough", "specular", "occlusion", "bounce", "environment")
LEVEL = math.log(0.4), 0.3


def _model(lights, *parts):
    return LightModel(lights, "oren-nayar", VIEW, 100.0, frozenset(parts))


def _x(model, seed=0):
    lower, upper = model.bounds
    inner = np.random.default_rng(seed).uniform(0.3, 0.7, model.size)
    return np.concatenate([lower + inner * (upper - lower), [-0.8, 0.9]])


@pytest.mark.parametrize("skin", [False, True])
def test_slope_and_curvature_are_those_of_the_cost(skin):
    model = _model(2, *PARTS)
    x = _x(model)
    step = 1e-4

    def at(y):
        return light_prior(model, y, *LEVEL, skin, 1.3)

    here = at(x)
    # The scale has no prior of its own; the highlight's, which is in its unit, is taken where it is.
    for k in {*range(len(x))} - {len(x) - 2}:
        ahead, behind = (at(x + sign * step * np.eye(len(x))[k]) for sign in (1, -1))
        assert here.slope[k] == pytest.approx((ahead.cost - behind.cost) / (2 * step), rel=1e-5, abs=1e-5)
        assert here.curvature[k] == pytest.approx((ahead.slope[k] - behind.slope[k]) / (2 * step), abs=1e-3)


def test_lamps_of_any_direction_are_alike_and_each_more_is_less_probable():
    x = np.array([0.1, 0.2, 0.4, -0.8, 1.0])

    def cost(lights, y):
        return light_prior(_model(lights), y, *LEVEL, False, 1.0).cost

    assert cost(1, x) == cost(1, np.append([-0.9, 0.5], x[2:]))
    none, one, two = (cost(n, np.append(np.tile(x[:3], n), x[3:])) for n in range(3))
    # Density over the sphere and of the strength, half as probable; lamps may stand in either order.
    assert one - none > math.log(2) + math.log(4 * math.pi)
    assert two - one == pytest.approx(one - none - math.log(2))


@pytest.mark.parametrize(("seen", "noise"), [(0.2, 0.05), (0.95, 0.1), (0.5, 1.0)])
def test_log_odds_of_a_part_are_the_ratio_of_evidences(seen, noise):
    """A fill that is measured as `seen`: normal prior and likelihood have their evidence in closed form."""
    model, mean, deviation = _model(0, "occlusion"), FILL.mean, FILL.deviation
    prior = light_prior(model, np.array([0.5, -0.8, 1.0]), *LEVEL, False, 1.0)
    precision = 1 / deviation**2 + 1 / noise**2
    x = (mean / deviation**2 + seen / noise**2) / precision

    def log_normal(value, middle, variance):
        return -0.5 * (value - middle) ** 2 / variance - 0.5 * math.log(2 * math.pi * variance)

    expected = log_normal(seen, mean, deviation**2 + noise**2) - log_normal(seen, 1.0, noise**2)
    plan = parts_steps(model, np.array([x]), np.array([[1 / precision]]), prior, EstimateOptions())
    (told,) = [step.evidence for step in plan if step.stage == "albedo.occlusion"]
    assert float(told.removeprefix("log odds ")) == pytest.approx(expected, abs=0.051)


def test_every_part_has_a_row_that_says_why_it_is_not_in_the_model():
    model = _model(0, "occlusion", "environment")
    options = EstimateOptions(skip=("albedo.bounce",))
    x = _x(model)
    prior = light_prior(model, x, *LEVEL, False, 1.0)
    plan = {s.stage: s for s in parts_steps(model, x, 0.01 * np.eye(len(x)), prior, options)}
    ran = {stage for stage, step in plan.items() if step.ran}
    assert len(plan) == len(PARTS)
    assert ran == {"albedo.occlusion", "albedo.environment"}
    assert plan["albedo.bounce"].reason == "left out by the caller"
    assert plan["albedo.specular"].reason == "nothing that it could change"
