"""`LinearModel`: a mean and directions of change, learned from samples; of reflectance, shape and light."""

from dataclasses import dataclass

import numpy as np

from scan2albedo.core.arrays import ArrayLike, FloatArray, checked_array, norms
from scan2albedo.errors import ReflectanceError

_RANK_TOLERANCE = 1e-12
"""Eigenvalues below this share of the largest are rounding."""
_ROUNDING = 1e-28
"""So are those below this share of the squared values themselves."""


@dataclass(frozen=True)
class LinearModel:
    """Values mean + sum b_i basis_i of coefficients b (N,) of unit variance."""

    mean: FloatArray
    """(...)."""
    basis: FloatArray
    """(N, ...)."""

    @property
    def components(self) -> int:
        """N, the number of coefficients."""
        return len(self.basis)

    @property
    def deviation(self) -> FloatArray:
        """(N,): standard deviation of the samples along each direction, which is its length."""
        return norms(self.basis.reshape(self.components, self.mean.size))

    def at(self, coefficients: ArrayLike, name: str = "coefficients") -> FloatArray:
        """Return the values (...) of coefficients (N,); `checked_coefficients` says what it raises."""
        b = checked_coefficients(coefficients, (self.components,), name)
        return self.mean + np.tensordot(b, self.basis, 1)

    def check(self, what: str, shape: tuple[int, ...]) -> None:
        """Raise `ReflectanceError` when mean or basis do not fit the mean's `shape`, or are not finite."""
        for name, array, expected in (("mean", self.mean, shape), ("basis", self.basis, ("N", *shape))):
            checked_array(array, expected, f"{what} {name}", ReflectanceError, finite=ReflectanceError)


def principal_directions(
    deviations: FloatArray, most: int | None, *, size: float
) -> tuple[FloatArray, float]:
    """Return weights (N, K) that sum deviations X (K, ...) to the directions of most variance, and all of it.

    X X^T = U diag(e) U^T; direction i is X^T u_i / sqrt(K - 1), the largest entry of u_i positive. Rounding,
    of X and of values whose squares sum to `size`, is left out: N is at most the rank, K - 1, and `most`.
    """
    count = len(deviations)
    rows = deviations.reshape(count, -1)
    values, vectors = np.linalg.eigh(rows @ rows.T)
    values, vectors = np.maximum(values[::-1], 0.0), vectors[:, ::-1]
    rank = int((values > max(_RANK_TOLERANCE * values[0], _ROUNDING * count * size)).sum())
    kept = min(rank, count - 1, count if most is None else most)
    sign = np.where(vectors[np.abs(vectors).argmax(0), np.arange(count)] < 0, -1.0, 1.0)
    spread = max(count - 1, 1)
    return (vectors * sign)[:, :kept].T / np.sqrt(spread), float(values.sum() / spread)


def require_one_topology(one: str, count: int, other: str, expected: int) -> None:
    """Raise ReflectanceError, naming both in words, for numbers of vertices that differ."""
    if count != expected:
        raise ReflectanceError(f"{one} has {count} vertices, {other} {expected}; bring all to one topology")


def checked_coefficients(values: ArrayLike | None, shape: tuple[int, ...], name: str) -> FloatArray:
    """Return coefficients, 0 for None; `ValueError` for another shape, `ReflectanceError` for NaN."""
    given = np.zeros(shape) if values is None else np.array(values, float)
    return checked_array(given, shape, name, finite=ReflectanceError)
