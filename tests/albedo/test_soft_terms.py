"""Soft light in the search: derivatives by every parameter, its plain values, and its floor."""

import numpy as np
import pytest
from helpers.lit_scenes import hemisphere_geometry, lamps_and_waves

from scan2albedo.albedo.light_parameters import LightModel
from scan2albedo.albedo.soft_terms import DARKEST, SoftTerms
from scan2albedo.lighting.environment_light import open_transfer

VIEW = (0.0, 0.0, 1.0)
STEP = 1e-3
SOFT = ("occlusion", "bounce", "environment")


def _model(lights, *parts):
    return LightModel(lights, "lambert", VIEW, 80.0, frozenset(parts))


@pytest.fixture(scope="module")
def surface():
    """Return (N, 3) normals, and the terms of points of which something is hidden, among 20 patches."""
    _, normal, mask = hemisphere_geometry(24)
    normal = normal[mask]
    rng = np.random.default_rng(0)
    patches = 20
    up = rng.uniform(0, 1, (len(normal), patches)) ** 8
    up /= up.sum(1, keepdims=True)
    factors = rng.uniform(0, 0.3 / patches, (patches, patches))
    transfer = open_transfer(normal) * rng.uniform(0.5, 1, (len(normal), 1))
    down = (up / up.sum(0)).T
    return normal, SoftTerms(transfer, lambda light: up @ (factors @ (down @ light)))


def _lit(surface, model, x):
    """Return the light (N,) and its slopes (N, P): lamps of which the strength alone has a slope."""
    normal, terms = surface
    light, slopes = np.ones(len(normal)), np.zeros((len(normal), model.size))
    for k in range(model.lights):
        px, py, log_strength = x[3 * k : 3 * k + 3]
        slopes[:, 3 * k + 2] = np.exp(log_strength) * np.maximum(normal @ model.direction(px, py), 0)
        light += slopes[:, 3 * k + 2]
    terms.add(model, x, light, slopes)
    return light, slopes


def _inner_x(model):
    """Return parameters away from their bounds."""
    return lamps_and_waves(model, ((24, 6), (-32, 18)), (1.5, 0.8))


@pytest.mark.parametrize(
    ("lights", "parts"),
    [(0, SOFT), (1, ("occlusion",)), (1, ("bounce",)), (1, ("environment",)), (2, SOFT)],
)
def test_derivatives_equal_central_differences(surface, lights, parts):
    model = _model(lights, *parts)
    x = _inner_x(model)
    light, slopes = _lit(surface, model, x)
    assert light.min() > 2 * DARKEST
    for k in {*range(2, 3 * lights, 3), *range(3 * lights, model.size)}:
        step = np.eye(model.size)[k] * STEP
        ahead, behind = (_lit(surface, model, x + s)[0] for s in (step, -step))
        assert slopes[:, k] == pytest.approx((ahead - behind) / (2 * STEP), abs=1e-5), k


@pytest.mark.parametrize("part", ["occlusion", "bounce", "environment"])
def test_soft_light_at_its_plain_value_is_constant_light(surface, part):
    plain = _model(1)
    x, model = _inner_x(plain), _model(1, part)
    more = plain.extend(x, model)
    more[model.slices[part]] = 1.0 if part == "occlusion" else 0.0
    assert _lit(surface, model, more)[0] == pytest.approx(_lit(surface, plain, x)[0], abs=1e-12)


def test_light_is_never_darker_than_some_and_has_no_derivative_there(surface):
    x = np.zeros(8)
    x[2] = -1.7
    light, slopes = _lit(surface, _model(0, "environment"), x)
    dark = light == DARKEST
    assert 0 < dark.mean() < 1
    assert not slopes[dark].any()
    assert slopes[~dark].any()


def test_what_cannot_bounce_does_not(surface):
    normal, terms = surface
    model = _model(1, "bounce")
    x = _inner_x(model)
    alone, slopes = _lit((normal, SoftTerms(terms.transfer, None)), model, x)
    assert not slopes[:, model.slices["bounce"]].any()
    assert (alone < _lit(surface, model, x)[0]).all()


def test_fill_lies_between_occluded_and_constant_ambient_light(surface):
    occlusion = surface[1].transfer[:, 0]
    model = _model(0, "occlusion")
    for fill, expected in ((0.0, occlusion), (1.0, np.ones(len(occlusion))), (0.5, (1 + occlusion) / 2)):
        assert _lit(surface, model, np.array([fill]))[0] == pytest.approx(expected)
