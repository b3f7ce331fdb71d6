import numpy as np
import pytest

from scan2albedo.statistics import robust

RESIDUALS = np.linspace(-5, 5, 1001)
STEP = RESIDUALS[1] - RESIDUALS[0]


@pytest.mark.parametrize(
    ("loss", "weights"),
    [
        (lambda r: robust.student_t_loss(r**2, 4.0), lambda r: robust.student_t_weights(r**2, 4.0)),
        (lambda r: robust.student_t_loss(r**2, 4.0, 3), lambda r: robust.student_t_weights(r**2, 4.0, 3)),
        (lambda r: robust.huber_loss(r, 1.5), lambda r: robust.huber_weights(r, 1.5)),
        (lambda r: 2 * np.log1p((r / 2) ** 2), lambda r: robust.cauchy_weights(r, 2.0)),
        (lambda r: r**2 / (2 + r**2 / 2), lambda r: robust.geman_mcclure_weights(r, 2.0)),
        (lambda r: -2 / 3 * np.maximum(1 - (r / 2) ** 2, 0) ** 3, lambda r: robust.tukey_weights(r, 2.0)),
    ],
    ids=["student t", "of three", "huber", "cauchy", "geman mcclure", "tukey"],
)
def test_weights_times_residuals_are_the_slopes_of_the_loss(loss, weights):
    slope = np.gradient(loss(RESIDUALS), STEP)
    np.testing.assert_allclose(weights(RESIDUALS) * RESIDUALS, slope, atol=0.01)


def test_weights_at_known_places():
    residual = np.array([0.0, 1.0, 2.0])
    np.testing.assert_array_equal(robust.huber_weights(residual, 1.0), [1, 1, 0.5])
    np.testing.assert_array_equal(robust.cauchy_weights(residual, 1.0), [1, 1 / 2, 1 / 5])
    np.testing.assert_allclose(robust.geman_mcclure_weights(residual, 1.0), [1, 1 / 4, 1 / 25])
    np.testing.assert_array_equal(robust.tukey_weights(residual, 2.0), [1, (3 / 4) ** 2, 0])
    np.testing.assert_array_equal(robust.student_t_weights(residual**2, 3.0), [4 / 3, 1, 4 / 7])
