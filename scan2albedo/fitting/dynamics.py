"""M q'' + D q' + K q = f, backward Euler, one sparse factorisation for all steps of a stage."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from scan2albedo.errors import FitError

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class State:
    """Displacement `q` (C, 3) of the control points and its `velocity` (C, 3) per unit of time."""

    q: FloatArray
    velocity: FloatArray

    @classmethod
    def at_rest(cls, count: int) -> State:
        """Return zero displacement and velocity of `count` control points."""
        return cls(np.zeros((count, 3)), np.zeros((count, 3)))


class ImplicitSystem:
    """One stage of the dynamics, factored once, the same scalar matrix for x, y and z.

    With the forces f(q) written as springs whose stiffness is at most 2 C, one step solves

        (M / dt^2 + D / dt + K + C) q' = M (q + dt v) / dt^2 + (D / dt + C) q + f(q).

    The term C (q' - q) takes the springs' own stiffness implicitly too: it bounds every step, so the
    step is stable for any dt, K and mass, and it vanishes at the equilibrium K q = f.

    Parameters
    ----------
    mass, damping : (C,) float64
        Diagonals of M and D; non-negative, mass positive.
    stiffness : (C, C) sparse
        K, symmetric positive semi-definite.
    force_stiffness : (C, C) sparse
        C, symmetric positive semi-definite.
    time_step : float
        dt > 0.
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
        self._held = (sparse.diags(np.asarray(damping, float) / self.time_step) + force_stiffness).tocsr()
        matrix = sparse.diags(self._mass[:, 0] / self.time_step**2) + self._held + stiffness
        self._solve = factorized(matrix)

    def step(self, state: State, force: FloatArray) -> State:
        """Return the state one time step later under the force (C, 3) at `state`."""
        dt = self.time_step
        inertia = self._mass * (state.q / dt**2 + state.velocity / dt)
        q = self._solve(inertia + self._held @ state.q + force)
        return State(q, (q - state.q) / dt)

    def energy(self, state: State) -> float:
        """Return (v^T M v + q^T K q) / 2, which no step without force can raise."""
        kinetic = float(np.sum(self._mass * state.velocity**2))
        return 0.5 * (kinetic + float(np.sum(state.q * (self._stiffness @ state.q))))


def factorized(matrix: sparse.spmatrix) -> Callable[[FloatArray], FloatArray]:
    """Return a solver for a symmetric positive definite (C, C) matrix and (C, K) right-hand sides.

    The matrix is scaled to unit diagonal first, so that it factors whatever its units. CHOLMOD's
    supernodal factorisation through cholespy; SuperLU where cholespy is not there or the matrix is
    indefinite by rounding.

    Raises
    ------
    FitError
        When the matrix holds values that are not finite, or is singular.
    """
    csc = sparse.csc_matrix(matrix)
    diagonal = csc.diagonal()
    if not np.isfinite(csc.data).all() or not (diagonal > 0).all():
        raise FitError(
            "the fit's system matrix is not positive definite: stiffness, mass, damping and time step "
            "must be finite and not all zero"
        )
    scale = 1 / np.sqrt(diagonal)
    scaled = (sparse.diags(scale) @ csc @ sparse.diags(scale)).tocsc()
    solve = _cholesky(scaled)
    return lambda rhs: scale[:, None] * solve(scale[:, None] * rhs)


def _cholesky(matrix: sparse.csc_matrix) -> Callable[[FloatArray], FloatArray]:
    try:
        from cholespy import CholeskySolverD, MatrixType
    except ImportError:
        return splu(matrix).solve
    coo = matrix.tocoo()
    try:
        solver = CholeskySolverD(
            matrix.shape[0],
            coo.row.astype(np.int32),
            coo.col.astype(np.int32),
            coo.data.astype(np.float64),
            MatrixType.COO,
        )
    except ValueError:
        return splu(matrix).solve

    def solve(rhs: FloatArray) -> FloatArray:
        result = np.zeros_like(rhs, order="C")
        solver.solve(np.ascontiguousarray(rhs), result)
        return result

    return solve
