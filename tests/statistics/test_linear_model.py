"""Linear models against closed forms: one direction, a known covariance, and what nothing is known of."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from scan2albedo.errors import ModelError
from scan2albedo.statistics.linear_model import LinearModel, principal_directions

RNG = np.random.default_rng(0)
MODEL = LinearModel(RNG.normal(size=(5, 3)), RNG.normal(size=(4, 5, 3)))


def test_values_of_coefficients_lie_along_the_directions():
    assert_allclose(MODEL.at(np.zeros(4)), MODEL.mean)
    assert_allclose(MODEL.at([0, 0, 2, 0]) - MODEL.mean, 2 * MODEL.basis[2])
    assert_allclose(MODEL.of(np.array([3, 1])).at(np.ones(4)), MODEL.at(np.ones(4))[[3, 1]])
    assert_allclose(MODEL.of(np.s_[:, 1]).at(np.ones(4)), MODEL.at(np.ones(4))[:, 1])
    with pytest.raises(ValueError, match=r"coefficients is \(3,\), expected \(4,\)"):
        MODEL.at(np.ones(3))
    with pytest.raises(ModelError, match="NaN"):
        MODEL.at([0, 0, np.nan, 0])


def test_its_own_values_come_back_without_a_prior():
    truth = RNG.normal(size=4)
    assert_allclose(MODEL.fit(MODEL.at(truth), prior=0).mean, truth, rtol=1e-10)


@pytest.mark.parametrize("prior", [0.1, 1.0, 10.0])
def test_one_direction_has_the_closed_form_of_ridge_regression(prior):
    along = np.array([3.0, 4.0])
    posterior = LinearModel(np.zeros(2), along[None]).fit(2.0 * along + [4, -3], prior=prior)
    assert posterior.mean == pytest.approx(2 * 25 / (25 + prior))
    assert posterior.deviation == pytest.approx(1 / np.sqrt(25 + prior))


def test_deviations_are_those_of_fits_to_noisy_values():
    rng = np.random.default_rng(1)
    found = []
    for _ in range(2000):
        truth = rng.normal(size=4)
        posterior = MODEL.fit(MODEL.at(truth) + rng.normal(size=(5, 3)))
        found.append((posterior.mean - truth) / posterior.deviation)
    assert_allclose(np.std(found, axis=0), 1, atol=0.06)


def test_what_the_values_leave_open_is_unknown():
    posterior = LinearModel(np.zeros(2), np.array([[1.0, 0], [0, 0]])).fit(np.array([3.0, 1]), prior=0)
    assert_allclose(posterior.mean, [3, 0])
    assert_allclose(posterior.deviation, [1, np.inf])


def test_directions_have_the_covariance_of_the_samples():
    samples = RNG.normal(size=(6, 4, 2))
    off = samples - samples.mean(0)
    basis, variance = principal_directions(off, size=float(np.sum(samples**2)))
    assert len(basis) == 5
    flat = basis.reshape(5, -1)
    assert_allclose(flat.T @ flat, np.cov(samples.reshape(6, -1).T), atol=1e-12)
    assert variance == pytest.approx(np.sum(LinearModel(samples.mean(0), basis).deviation ** 2))
    first, _ = principal_directions(off, 2, size=1.0, part=np.s_[..., 0])
    assert_allclose(first[..., 0], principal_directions(off[..., 0], 2, size=1.0)[0])
