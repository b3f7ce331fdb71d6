"""How strong each flash was is found beside the reflectance, up to one scale a channel."""

from dataclasses import replace

import numpy as np
import pytest
from bench.judging import relative_rmse
from numpy.testing import assert_allclose
from worlds.flash_captures import head_capture, samples_of

from scan2albedo.core import Budget
from scan2albedo.reflectance import ReflectanceFitOptions, fit_reflectance, vertex_fit
from scan2albedo.reflectance.robust_fit import Observations
from scan2albedo.reflectance.vertex_fit import divided_by_gain

GAINS = ReflectanceFitOptions(light_gains=True)


@pytest.fixture(autouse=True)
def few_vertices(monkeypatch):
    monkeypatch.setattr(vertex_fit, "_GAIN_VERTICES", 300)


@pytest.fixture(scope="module")
def capture():
    return head_capture(600)


@pytest.fixture(scope="module")
def gain():
    drawn = np.random.default_rng(5).uniform(0.8, 1.25, (11, 3))
    return drawn / drawn.mean(0)


def lit_by(capture, gain, **how):
    """Samples under flashes of that strength, with the noise of the camera."""
    samples = samples_of(capture, **how)
    more = samples_of(capture, said_noise=1e-9).observed_linear * (gain[samples.light][:, None] - 1)
    return replace(samples, observed_linear=samples.observed_linear + more)


@pytest.mark.parametrize("shadowed", [0.0, 0.03])
def test_gains_are_found(capture, gain, shadowed):
    samples = lit_by(capture, gain, noise=0.01, shadowed=shadowed)
    without, fit = fit_reflectance(samples), fit_reflectance(samples, options=GAINS)
    assert (without.light_gain == 1).all()
    assert_allclose(fit.light_gain, gain, atol=0.02 if shadowed else 0.006)
    assert_allclose(fit.light_gain.mean(0), 1)
    errors = [
        relative_rmse(one.reflectance.diffuse_linear, capture.truth.diffuse_linear) for one in (fit, without)
    ]
    assert errors[0] < 0.02
    assert errors[0] < 0.6 * errors[1]
    assert np.nanmedian(without.misfit) > np.nanmedian(fit.misfit)


def test_gains_without_noise_are_exact(capture, gain, monkeypatch):
    monkeypatch.setattr(vertex_fit, "_GAIN_ROUNDS", 300)
    monkeypatch.setattr(vertex_fit, "_GAIN_TOLERANCE", 1e-9)
    options = replace(GAINS, loss="squares")
    fit = fit_reflectance(lit_by(capture, gain, said_noise=1e-6), options=options)
    assert_allclose(fit.light_gain, gain, rtol=1e-5)


def test_observations_divided_by_gains_keep_their_worth():
    """y / g with precision g^2 / sigma^2: residuals over sigma stay as they are."""
    rng = np.random.default_rng(6)
    observed, precision, gain = rng.random((3, 4, 3)), rng.random((3, 4, 3)), rng.uniform(0.5, 2, (2, 3))
    data = Observations(observed, precision, rng.random((3, 4, 4)), np.zeros(6), np.ones(6))
    light = np.array([1, 0, 1])
    divided, model = divided_by_gain(data, light, gain), rng.random((3, 4, 3))
    assert_allclose(
        divided.precision * (divided.observed - model) ** 2,
        precision * (observed - gain[light][:, None] * model) ** 2,
    )


def test_a_flash_that_lit_nothing_has_no_gain(capture):
    samples = samples_of(capture, noise=0.01)
    valid = samples.valid & (samples.light != 4)[:, None, None]
    for options in (ReflectanceFitOptions(), GAINS):
        fit = fit_reflectance(replace(samples, valid=valid), options=options)
        assert np.isnan(fit.light_gain[4]).all()
        assert np.isfinite(np.delete(fit.light_gain, 4, 0)).all()
        assert np.isfinite(fit.parameters).all()


def test_a_budget_ends_the_alternation(capture, gain):
    fit = fit_reflectance(lit_by(capture, gain, noise=0.01), options=GAINS, budget=Budget(evaluations=2))
    assert not fit.converged
    assert np.isfinite(fit.parameters).all()
