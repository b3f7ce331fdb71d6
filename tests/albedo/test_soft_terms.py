"""Soft light in the search: derivatives by every parameter, and the parts that sum to the light."""

import math

import numpy as np
import pytest
from scipy import sparse

from scan2albedo.albedo.levels import build_level, usable_texels
from scan2albedo.albedo.light_parameters import LightModel, SoftState
from scan2albedo.albedo.residual_objective import ResidualProblem
from scan2albedo.albedo.shadows import ShadowLattice
from scan2albedo.albedo.soft_terms import DARKEST, SoftTerms, ridge
from scan2albedo.core import Meter
from scan2albedo.lighting.environment_light import open_transfer
from scan2albedo.lighting.interreflection import Bounce
from scan2albedo.synthetic import hemisphere, light_at

VIEW = (0.0, 0.0, 1.0)
STEP = 1e-5


def _model(lights, **parts):
    return LightModel(lights, "oren-nayar", VIEW, 80.0, **parts)


ALL = {"near": True, "rough": True, "specular": True, "occlusion": True, "bounce": True, "environment": True}


def _hidden(normal, seed=0):
    """Return the terms of points of which something is hidden at random, with a bounce among 20 patches."""
    rng = np.random.default_rng(seed)
    count, patches = len(normal), 20
    up = sparse.csr_matrix(rng.uniform(0, 1, (count, patches)) ** 8)
    up = sparse.csr_matrix(up / up.sum(1))
    factors = rng.uniform(0, 0.3 / patches, (patches, patches))
    transfer = open_transfer(normal) * rng.uniform(0.5, 1, (count, 1))
    return SoftTerms(transfer, Bounce(factors, up, sparse.csr_matrix((up / up.sum(0)).T)))


@pytest.fixture(scope="module")
def problem():
    image = hemisphere(size=48, lights=[light_at(30)], texture="skin").image
    level = build_level(image, usable_texels(image), 32)
    return ResidualProblem(level, ShadowLattice(level, None, 0.2), Meter("albedo", ""), _hidden(level.normal))


def _inner_x(model):
    """Return parameters away from their bounds."""
    toward = np.array([[0.4, 0.1, 0.9], [-0.5, 0.3, 0.8]])[: model.lights]
    x = model.from_lights(
        toward / np.linalg.norm(toward, axis=1, keepdims=True), np.array([1.5, 0.8])[: model.lights]
    )
    if model.environment:
        x[-8:] = np.random.default_rng(1).uniform(-0.15, 0.15, 8)
    return x


@pytest.mark.parametrize(
    ("lights", "parts"),
    [
        (0, {"occlusion": True, "bounce": True, "environment": True}),
        (1, {"occlusion": True}),
        (1, {"bounce": True}),
        (1, {"environment": True}),
        (2, ALL),
    ],
)
def test_derivatives_equal_central_differences(problem, lights, parts):
    model = _model(lights, **parts)
    x = _inner_x(model)
    here = problem.at(model, x, outlines=False)
    assert here.light.min() > 2 * DARKEST
    for k in range(model.size):
        step = np.eye(model.size)[k] * STEP
        ahead, behind = (problem.at(model, x + s, outlines=False).light for s in (step, -step))
        expected = (ahead - behind) / (2 * STEP)
        # Cells at a lamp's terminator have no derivative; bounced light brings a little of them to all.
        error = np.abs(here._slopes[0][k] - expected)
        assert np.median(error) < 1e-4, k
        assert np.percentile(error, 95) < 2e-3 * max(1.0, np.abs(expected).max()), k


@pytest.mark.parametrize("part", ["occlusion", "bounce", "environment"])
def test_soft_light_at_its_plain_value_is_constant_light(problem, part):
    plain = _model(1)
    model = plain.with_part(part)
    x = _inner_x(plain)
    more = plain.extend(x, model)
    at = model.position_of(part)
    more[at:] = 1.0 if part == "occlusion" else 0.0
    assert problem.at(model, more).light == pytest.approx(problem.at(plain, x).light, abs=1e-12)


def test_light_is_never_darker_than_some_and_has_no_derivative_there(problem):
    model = _model(0, environment=True)
    x = np.zeros(8)
    x[2] = -1.7
    here = problem.at(model, x)
    dark = here.light == DARKEST
    assert 0 < dark.mean() < 1
    assert not here._slopes[0][:, dark].any()
    assert here._slopes[0][:, ~dark].any()


def test_columns_sum_to_the_light(problem):
    model = _model(2, **ALL)
    here = problem.at(model, _inner_x(model))
    columns = here.columns()
    assert columns.shape == (2 + 10, len(here.light))
    assert columns.sum(0) == pytest.approx(here.light, abs=1e-9)


def test_without_bounce_nothing_is_thrown_back(problem):
    terms = SoftTerms.unshadowed(problem.level.normal)
    columns = terms.columns(SoftState(1.0, 0.4, np.zeros(8)), np.ones((1, len(terms.transfer))))
    assert not columns[-1].any()
    assert columns[1] == pytest.approx(np.ones(len(terms.transfer)))


def test_fill_lies_between_occluded_and_constant_ambient_light(problem):
    terms = problem.soft
    assert terms.ambient(0.0) == pytest.approx(terms.transfer[:, 0])
    assert terms.ambient(1.0) == pytest.approx(np.ones(len(terms.transfer)))
    assert terms.ambient(0.5) == pytest.approx((1 + terms.transfer[:, 0]) / 2)


def test_the_ridge_prices_harmonics_alone_and_has_their_curvature():
    model = _model(1, **ALL)
    x = _inner_x(model)
    cost, weight = ridge(model, x)
    assert cost == pytest.approx(0.5 * weight[-1] * float(x[-8:] @ x[-8:]))
    assert not weight[:-8].any()
    assert (weight[-8:] > 0).all()
    assert ridge(_model(1), _inner_x(_model(1)))[0] == 0
    assert math.isclose(ridge(model, 2 * x)[0], 4 * cost)
