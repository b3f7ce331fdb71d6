import itertools

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import sparse
from scipy.optimize import lsq_linear

from scan2albedo.core import Budget, Meter
from scan2albedo.eyeglasses.weights import minimize_bounded


def solve(matrix, right, evaluations=None):
    meter = Meter("test", "1", Budget(evaluations=evaluations))
    given = sparse.csr_matrix(matrix), right
    return minimize_bounded(*given, tolerance=1e-10, max_steps=80, meter=meter), meter


def problem(seed, least):
    """A positive definite matrix (40, 40) and right sides whose free minimum lies outside of the bounds."""
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((40, 40))
    matrix = root @ root.T + least * np.eye(40)
    return matrix, matrix @ rng.uniform(-2, 3, (40, 2))


@pytest.mark.parametrize("seed", range(5))
def test_agrees_with_a_dense_reference(seed):
    matrix, right = problem(seed, 0.1)
    found, meter = solve(matrix, right)
    assert meter.evaluations == found.steps.sum() == len(meter.rows)
    factor = np.linalg.cholesky(matrix)
    for x, goal in zip(found.x.T, np.linalg.solve(factor, right).T, strict=True):
        reference = lsq_linear(factor.T, goal, (0, 1), method="bvls", tol=1e-14)
        assert_allclose(x, reference.x, atol=1e-8)
    assert found.residual.max() <= 1e-10
    assert ((found.x == 0) | (found.x == 1)).any()


def test_a_budget_keeps_the_best_so_far():
    matrix, right = problem(1, 1e-3)

    def energy(x):
        return (x * (0.5 * (matrix @ x) - right)).sum()

    energies = [energy(np.clip(np.linalg.solve(matrix, right), 0, 1))]
    for evaluations in (1, 2, 4, 100):
        found, meter = solve(matrix, right, evaluations)
        energies.append(energy(found.x))
        assert meter.evaluations <= evaluations
        assert_array_equal(found.x, np.clip(found.x, 0, 1))
    assert energies[0] > energies[1]
    assert all(a >= b for a, b in itertools.pairwise(energies))


def test_it_begins_at_the_clipped_solution():
    matrix = np.diag([2.0, 4.0, 5.0]) + 0.5
    inside = np.array([[0.2], [0.5], [0.9]])
    found, _ = solve(matrix, matrix @ inside)
    assert_allclose(found.x, inside, rtol=1e-12)
    assert found.steps.sum() == 0


def test_an_indefinite_matrix_is_refused():
    matrix = sparse.diags([[-0.5, 1.0, 1.0], [0.9, 0.9], [0.9, 0.9]], [0, 1, -1])
    with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
        solve(matrix, np.ones((3, 1)))
