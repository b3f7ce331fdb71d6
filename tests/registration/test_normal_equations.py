"""The compiled normal equations against the plain sums they stand for."""

import numpy as np

from scan2albedo.registration.grid_icp import _accumulate, _accumulate_point, _solve6


def test_closed_sums_equal_the_rows_written_out():
    rng = np.random.default_rng(0)
    matrix, gradient, row = np.zeros((6, 6)), np.zeros(6), np.zeros(6)
    expected, right = np.zeros((6, 6)), np.zeros(6)
    for _ in range(5):
        x, error, normal = rng.normal(size=(3, 3))
        _accumulate(matrix, gradient, row, 0.7, *normal, *x, *error)
        _accumulate_point(matrix, gradient, 0.1, *x, *error)
        for weight, axis in [(0.7, normal), *((0.1, unit) for unit in np.eye(3))]:
            jacobian = np.r_[np.cross(x, axis), axis]
            expected += weight * np.outer(jacobian, jacobian)
            right -= weight * jacobian * (axis @ error)
    np.testing.assert_allclose(np.tril(matrix), np.tril(expected), atol=1e-12)
    np.testing.assert_allclose(gradient, right, atol=1e-12)
    step = np.zeros(6)
    assert _solve6(matrix.copy(), gradient, step)
    np.testing.assert_allclose(expected @ step, right, atol=1e-9)


def test_a_singular_system_is_reported():
    assert not _solve6(np.zeros((6, 6)), np.zeros(6), np.zeros(6))
