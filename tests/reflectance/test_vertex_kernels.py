"""All vertices at once agree with scipy's nnls, one by one and row by row."""

import numpy as np
import pytest
from bench.flash_captures import MEAN, PRIOR, design, normal_equations
from numpy.testing import assert_allclose
from scipy.optimize import nnls

from scan2albedo.reflectance import VertexSamples
from scan2albedo.reflectance.robust_fit import Observations, RobustFit
from scan2albedo.reflectance.vertex_kernels import solve_bounded, solve_free


def random_samples(seed, count=60, pairs=12, dark=0.0):
    """Samples of any sign and weight: bounds hold in many sets, channels are missing here and there."""
    rng = np.random.default_rng(seed)
    shape = (pairs, count, 3)
    lobes = np.abs(rng.standard_normal((pairs, count, 4))) * [0.3, 0.1, 0.4, 2.0]
    observed = lobes[..., :1] * rng.normal(0.3 - dark, 0.3, (count, 3)) + 0.3 * rng.standard_normal(shape)
    valid = rng.random(shape) < 0.9
    return VertexSamples(observed, rng.uniform(0.05, 0.3, shape), valid, lobes, np.zeros(pairs, int))


def evenly_sure(observed, sigma, lobes):
    shape = observed.shape
    return VertexSamples(
        observed, np.full(shape, sigma), np.ones(shape, bool), lobes, np.zeros(len(lobes), int)
    )


def bounded(samples):
    """Return estimates (V, 6), and those of scipy."""
    estimate = np.empty((samples.lobes.shape[1], 6))
    solve_bounded(normal_equations(samples), MEAN, PRIOR, estimate)
    return estimate, np.stack([nnls(*design(samples, v))[0] for v in range(len(estimate))])


@pytest.mark.parametrize("pairs", [1, 2, 5, 12])
@pytest.mark.parametrize("dark", [0.0, 0.3, 0.8])
def test_bounded_estimates_are_those_of_nnls(dark, pairs):
    estimate, expected = bounded(random_samples(0, dark=dark, pairs=pairs))
    assert_allclose(estimate, expected, atol=1e-9)
    assert ((estimate == 0) == (expected == 0)).all()


@pytest.mark.parametrize("column", [1, 2, 3])
@pytest.mark.parametrize("sigma", [1e-8, 1e-10, 1e-12])
def test_observations_beyond_all_precision_keep_the_estimate_finite(column, sigma):
    """A flash at the camera: two columns are one, and what the prior says of them drowns in rounding."""
    lobes = np.abs(np.random.default_rng(4).standard_normal((6, 10, 4)))
    lobes[..., column] = 3 / 8 * lobes[..., 0]
    normal = normal_equations(evenly_sure(0.5 * lobes[..., :1] * np.ones(3), sigma, lobes))
    estimate, center, deviation = np.empty((3, 10, 6))
    solve_bounded(normal, MEAN, PRIOR, estimate)
    solve_free(normal, MEAN, PRIOR, center, deviation)
    assert np.isfinite(estimate).all()
    assert np.isfinite(deviation).all()
    assert (deviation[:, 2 + column] < 1.01 / np.sqrt(PRIOR[2 + column])).all()
    assert (estimate[:, 2 + column] < 2).all()
    radiance = estimate[:, :3] + 3 / 8 * estimate[:, 2 + column, None]
    assert_allclose(radiance, 0.5, rtol=1e-4)


@pytest.mark.parametrize("loss", ["squares", "charbonnier", "cauchy"])
def test_weights_are_the_slope_of_the_loss(loss):
    """Half the weight is the derivative of a pair's loss by the mean square of its residuals."""
    sizes = np.array([0.1, 1.0, 3.0, 20.0])
    fits = []
    for change in (0.0, 1e-4):
        observed = np.sqrt((sizes**2 + change)[:, None, None] * np.ones((4, 1, 3)))
        nothing = np.zeros((4, 1, 4)), np.zeros(6), np.zeros(6)
        fit = RobustFit(Observations(observed, np.ones((4, 1, 3)), *nothing), loss)
        fit.scale[:] = 1
        fit._reweigh(np.arange(1))
        assert fit.scale == 1
        fits.append(fit)
    weight = fits[0].weight[:, 0]
    slope = (fits[1].loss - fits[0].loss) / 1e-4
    assert slope == pytest.approx(3 * 0.5 * weight.sum(), rel=1e-3)
    assert (np.diff(weight) <= 0).all()
    assert (weight[-1] == 1) == (loss == "squares")


def test_sums_that_overflow_give_no_number():
    """Neither the estimate of the vertex before nor 0 stands for what cannot be computed."""
    normal = normal_equations(random_samples(5, count=3))
    normal[1, 3:] = normal[1, 0, 6] = np.inf
    estimate = np.empty((3, 6))
    solve_bounded(normal, MEAN, PRIOR, estimate)
    assert np.isfinite(estimate[[0, 2]]).all()
    assert np.isnan(estimate[1]).any()


def test_nearly_equal_columns_do_not_keep_bounds_from_settling():
    """All lobes alike within 1e-8, noise of 1e-9: what falls and what does not is a matter of rounding."""
    rng = np.random.default_rng(0)
    lobes = np.abs(rng.standard_normal((8, 400, 1))) * [0.3, 0.1, 0.4, 2.0]
    lobes *= 1 + 1e-8 * rng.standard_normal(lobes.shape)
    observed = lobes[..., :1] * rng.normal(0.2, 0.4, (400, 3)) + 1e-9 * rng.standard_normal((8, 400, 3))
    samples = evenly_sure(observed, 1e-9, lobes)
    for v, both in enumerate(zip(*bounded(samples), strict=True)):
        rows, right = design(samples, v)
        left, least = (np.sum((rows @ one - right) ** 2) for one in both)
        assert left < 100 * least
