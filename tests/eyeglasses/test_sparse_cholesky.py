import numpy as np
import pytest
from scipy import sparse

from scan2albedo.eyeglasses.sparse_cholesky import SparseCholesky


def random_spd(count, density, seed):
    rng = np.random.default_rng(seed)
    part = sparse.random(count, count, density, random_state=rng, format="csr")
    return (part @ part.T + sparse.identity(count)).tocsr()


def grid_energy(n):
    line = sparse.diags([-np.ones(n - 1), 2 * np.ones(n), -np.ones(n - 1)], [-1, 0, 1])
    laplacian = sparse.kron(line, sparse.identity(n)) + sparse.kron(sparse.identity(n), line)
    return (laplacian @ laplacian).tocsr()


@pytest.mark.parametrize(
    "matrix",
    [random_spd(1, 1.0, 0), random_spd(40, 0.05, 1), random_spd(60, 0.3, 2), sparse.identity(9, format="csr")]
    + [grid_energy(17)],
    ids=["one", "sparse", "nearly dense", "identity", "grid"],
)
@pytest.mark.parametrize("share_held", [0.0, 0.3])
def test_solves_what_a_dense_solver_solves(matrix, share_held):
    rng = np.random.default_rng(5)
    system, count = SparseCholesky(matrix), matrix.shape[0]
    held, right = rng.random(count) < share_held, rng.standard_normal(count)
    system.refill(held)
    dense = matrix.toarray()[np.ix_(system.order, system.order)]
    dense[held], dense[:, held] = 0, 0
    dense[held, held] = 1
    np.testing.assert_allclose(system.solve(right), np.linalg.solve(dense, right), rtol=1e-9, atol=1e-12)


def test_a_refill_forgets_the_one_before():
    matrix = grid_energy(12)
    used, fresh = SparseCholesky(matrix), SparseCholesky(matrix)
    used.refill(np.arange(144) % 3 == 0)
    for system in (used, fresh):
        system.refill(np.zeros(144, bool))
    np.testing.assert_array_equal(used.solve(np.ones(144)), fresh.solve(np.ones(144)))


def test_an_indefinite_matrix_is_refused():
    system = SparseCholesky(sparse.diags([[-0.5, 1.0, 1.0], [0.9, 0.9], [0.9, 0.9]], [0, 1, -1]).tocsr())
    with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
        system.refill(np.zeros(3, bool))
