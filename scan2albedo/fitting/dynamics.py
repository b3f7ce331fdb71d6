"""M q'' + D q' + K q = f, backward Euler, one sparse factorisation for all steps of a stage."""

from collections.abc import Callable

import numpy as np
from cholespy import CholeskySolverD, MatrixType
from scipy import sparse
from scipy.sparse.linalg import splu

from scan2albedo.core.arrays import FloatArray, all_finite
from scan2albedo.errors import FitError

Springs = Callable[[FloatArray], FloatArray]


class ImplicitSystem:
    """One stage of the dynamics: backward Euler, factored once for all its steps.

    With the springs' own stiffness H, positive semi-definite, one step d solves

        (M / dt^2 + D / dt + K + H) d = M v / dt - K q + f

    by conjugate gradients from d = 0, preconditioned by M / dt^2 + D / dt + K + C. Each iteration lowers the
    energy, so that the step is stable wherever it is cut off. `mass` > 0 and `damping` >= 0 (C,) are the
    diagonals of M and D, `stiffness` K and `force_stiffness` C, the usual H, (C, C); `time_step` dt > 0.
    """

    def __init__(
        self,
        mass: FloatArray,
        damping: FloatArray,
        stiffness: sparse.spmatrix,
        force_stiffness: sparse.spmatrix,
        time_step: float,
    ) -> None:
        if not time_step > 0:
            raise ValueError(f"time_step must be > 0, got {time_step}")
        self.time_step = float(time_step)
        self._mass, self._stiffness = np.asarray(mass, float)[:, None], stiffness
        held = self._mass[:, 0] / self.time_step**2 + np.asarray(damping, float) / self.time_step
        self._still = (sparse.diags(held) + stiffness).tocsr()
        self._precondition = factorized(self._still + force_stiffness)

    def step(
        self, q: FloatArray, velocity: FloatArray, force: FloatArray, springs: Springs, iterations: int = 6
    ) -> FloatArray:
        """Return how far the control points move (C, 3) in a time step from displacement and velocity (C, 3).

        `force` (C, 3) acts at `q`, `springs` maps x (C, 3) to H x. Conjugate gradients end after
        `iterations`, or when the residual has fallen to a tenth of the first.
        """
        right = self._mass * velocity / self.time_step - self._stiffness @ q + force
        return conjugate_gradients(
            lambda x: self._still @ x + springs(x), right, self._precondition, iterations, tolerance=0.1
        )


def conjugate_gradients(
    product: Springs, right: FloatArray, precondition: Springs, iterations: int, tolerance: float
) -> FloatArray:
    """Return x (C, 3) with A x = `right` as nearly as `iterations` allow, from x = 0."""
    x, residual = np.zeros_like(right), right
    ahead = precondition(residual)
    direction, size = ahead, float(np.vdot(residual, ahead))
    enough = tolerance**2 * size
    for _ in range(iterations):
        if not size > enough:
            break
        along = product(direction)
        curvature = float(np.vdot(direction, along))
        if not curvature > 0:
            break
        length = size / curvature
        x = x + length * direction
        residual = residual - length * along
        ahead = precondition(residual)
        before, size = size, float(np.vdot(residual, ahead))
        direction = ahead + (size / before) * direction
    return x


def factorized(matrix: sparse.spmatrix) -> Callable[[FloatArray], FloatArray]:
    """Return a solver for a symmetric positive definite (C, C) matrix and (C, K) right-hand sides.

    The matrix is scaled to unit diagonal; SuperLU where it is indefinite by rounding. Raises `FitError` for
    values that are not finite, or a singular matrix.
    """
    csc = sparse.csc_matrix(matrix)
    diagonal = csc.diagonal()
    if not all_finite(csc.data) or not (diagonal > 0).all():
        raise FitError(
            "the fit's system matrix is not positive definite: stiffness, mass, damping and time step "
            "must be finite and not all zero"
        )
    scale = 1 / np.sqrt(diagonal)
    scaled = (sparse.diags(scale) @ csc @ sparse.diags(scale)).tocsc()
    coo = scaled.tocoo()
    entries = coo.row.astype(np.int32), coo.col.astype(np.int32), coo.data.astype(float)
    try:
        cholesky = CholeskySolverD(len(scale), *entries, MatrixType.COO)
    except ValueError:
        try:
            lu = splu(scaled)
        except RuntimeError as error:
            raise FitError(
                f"the fit's system matrix cannot be factored ({error}); a stiffness, a mass or the time step "
                "is extreme"
            ) from error
        return lambda rhs: scale[:, None] * lu.solve(scale[:, None] * rhs)

    def solve(rhs: FloatArray) -> FloatArray:
        scaled_rhs = np.ascontiguousarray(scale[:, None] * rhs)
        result = np.zeros_like(scaled_rhs)
        cholesky.solve(scaled_rhs, result)
        return scale[:, None] * result

    return solve
