"""The error measure: blind to one global scale, to nothing else."""

import numpy as np
import pytest

from scan2albedo.albedo import albedo_error

RNG = np.random.default_rng(0)
TRUTH = RNG.uniform(0.2, 0.8, (20, 30, 3))
MASK = RNG.random((20, 30)) > 0.3
MEAN_SQUARE = np.mean(TRUTH[MASK] ** 2)


@pytest.mark.parametrize(
    ("estimate", "expected"),
    [(4.2 * TRUTH, 0), (np.where(MASK[..., None], TRUTH, np.nan), 0), (0 * TRUTH, 1)],
    ids=["scaled", "nothing outside the mask", "black"],
)
def test_neither_scale_nor_what_lies_outside_the_mask_is_an_error(estimate, expected):
    error = albedo_error(estimate, TRUTH, MASK)
    assert error.relative_rmse == pytest.approx(expected, abs=1e-10)
    assert error.mse_percent == pytest.approx(100 * expected * MEAN_SQUARE, abs=1e-20)


def test_it_is_the_least_squares_scale():
    estimate = TRUTH + 0.1 * RNG.standard_normal(TRUTH.shape)
    scales = np.linspace(0.5, 1.5, 2001)
    brute = min(100 * np.mean((s * estimate - TRUTH)[MASK] ** 2) for s in scales)
    error = albedo_error(estimate, TRUTH, MASK)
    assert error.mse_percent == pytest.approx(brute, rel=1e-4)
    assert error.relative_rmse == pytest.approx(np.sqrt(error.mse_percent / 100 / MEAN_SQUARE))


@pytest.mark.parametrize(
    ("estimate", "mask", "message"),
    [
        (TRUTH, np.zeros_like(MASK), "must agree"),
        (TRUTH, MASK[:5], "must agree"),
        (np.where(MASK[..., None], np.nan, TRUTH), MASK, "NaN"),
    ],
)
def test_masks_that_do_not_fit_and_nan_are_refused(estimate, mask, message):
    with pytest.raises(ValueError, match=message):
        albedo_error(estimate, TRUTH, mask)
