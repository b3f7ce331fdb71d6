"""The error measure: blind to one global scale, to nothing else."""

import numpy as np
import pytest

from scan2albedo.albedo import albedo_error

RNG = np.random.default_rng(0)
TRUTH = RNG.uniform(0.2, 0.8, (20, 30, 3))
MASK = RNG.random((20, 30)) > 0.3


def test_a_scaled_truth_has_no_error():
    error = albedo_error(4.2 * TRUTH, TRUTH, MASK)
    assert error.mse_percent == pytest.approx(0, abs=1e-20)
    assert error.relative_rmse == pytest.approx(0, abs=1e-10)


def test_it_is_the_least_squares_scale():
    estimate = TRUTH + 0.1 * RNG.standard_normal(TRUTH.shape)
    scales = np.linspace(0.5, 1.5, 2001)
    brute = min(100 * np.mean((s * estimate - TRUTH)[MASK] ** 2) for s in scales)
    error = albedo_error(estimate, TRUTH, MASK)
    assert error.mse_percent == pytest.approx(brute, rel=1e-4)
    mean_square = np.mean(TRUTH[MASK] ** 2)
    assert error.relative_rmse == pytest.approx(np.sqrt(error.mse_percent / 100 / mean_square))


def test_texels_outside_the_mask_do_not_count():
    estimate = np.where(MASK[..., None], TRUTH, np.nan)
    assert albedo_error(estimate, TRUTH, MASK).relative_rmse < 1e-10


def test_black_is_all_wrong():
    assert albedo_error(np.zeros_like(TRUTH), TRUTH, MASK).relative_rmse == pytest.approx(1)


@pytest.mark.parametrize("mask", [np.zeros_like(MASK), MASK[:5]])
def test_masks_that_do_not_fit_are_refused(mask):
    with pytest.raises(ValueError, match="must agree"):
        albedo_error(TRUTH, TRUTH, mask)


def test_nan_is_refused():
    with pytest.raises(ValueError, match="NaN"):
        albedo_error(np.where(MASK[..., None], np.nan, TRUTH), TRUTH, MASK)
