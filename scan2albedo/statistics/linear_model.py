"""`LinearModel`: values that are a mean and a few directions of change; learned, evaluated, fitted."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from scan2albedo.core.arrays import ArrayLike, FloatArray, RealArray, checked_array, norms
from scan2albedo.errors import ModelError, Scan2AlbedoError

_RANK_TOLERANCE = 1e-12
"""Eigenvalues below this share of the largest are rounding."""
_ROUNDING = 1e-28
"""So are those below this share of the squared values themselves."""


@dataclass(frozen=True, eq=False)
class LinearModel:
    """Values x = mean + sum b_k basis_k of coefficients b (K,), which are normal and of unit variance.

    After Blanz, Vetter, "A Morphable Model for the Synthesis of 3D Faces", SIGGRAPH 1999.

    >>> model = LinearModel(np.zeros(2), np.array([[3.0, 4.0]]))
    >>> model.at([2.0]), model.deviation
    (array([6., 8.]), array([5.]))
    """

    error: ClassVar[type[Scan2AlbedoError]] = ModelError
    """Raised for numbers that are not finite, and for arrays that disagree."""

    mean: FloatArray
    """(...)."""
    basis: RealArray
    """(K, ...)."""

    @property
    def components(self) -> int:
        """K, the number of coefficients."""
        return len(self.basis)

    @property
    def deviation(self) -> FloatArray:
        """(K,): standard deviation of the values along each direction, which is its length."""
        return norms(self.basis.reshape(self.components, self.mean.size))

    def at(self, coefficients: ArrayLike) -> FloatArray:
        """Return the values (...) of coefficients (K,).

        Raises `ValueError` for another number of them, `error` for NaN and infinity.
        """
        b = checked_array(coefficients, (self.components,), "coefficients", finite=self.error)
        # No copy of a large basis of single precision.
        return self.mean + np.tensordot(b.astype(self.basis.dtype), self.basis, 1)

    def of(self, index: Any) -> "LinearModel":
        """Return the model of some of the values: those at an index into the mean."""
        several = index if isinstance(index, tuple) else (index,)
        return LinearModel(self.mean[index], self.basis[(slice(None), *several)])

    def fit(self, values: FloatArray, *, prior: float = 1.0) -> "Posterior":
        """Return the maximum a posteriori coefficients of `values` (...), which have noise of unit variance.

        They minimise |values - mean - sum b_k basis_k|^2 + prior |b|^2. With noise of a variance v let
        `prior` be v, and multiply the posterior's deviations by its root. Without a prior, 0, coefficients
        that the values leave open are 0, and their deviations infinite.
        """
        rows = self.basis.reshape(self.components, self.mean.size)
        precision = rows @ rows.T + prior * np.eye(self.components)
        return Posterior(precision, rows @ (values - self.mean).ravel())

    def require_shape(self, what: str, shape: tuple[int, ...]) -> None:
        """Raise `error`, naming the model, when mean or basis have other shapes or are not finite."""
        for name, array, expected in (("mean", self.mean, shape), ("basis", self.basis, ("N", *shape))):
            checked_array(array, expected, f"{what} {name}", self.error, finite=self.error)


@dataclass(frozen=True, eq=False)
class Posterior:
    """The normal distribution of K coefficients whose logarithm is h . b - b . P b / 2 and a constant."""

    precision: FloatArray
    """P (K, K)."""
    information: FloatArray
    """h (K,)."""

    @cached_property
    def _modes(self) -> tuple[FloatArray, FloatArray]:
        """Variances along K orthogonal directions, infinite where nothing is known, and these, as columns."""
        strength, directions = np.linalg.eigh(self.precision)
        known = strength > _RANK_TOLERANCE * strength[-1:]
        return np.divide(1, strength, out=np.full(len(strength), np.inf), where=known), directions

    @property
    def mean(self) -> FloatArray:
        """(K,): the likeliest coefficients; 0 along directions of which nothing is known."""
        variance, directions = self._modes
        finite = np.where(np.isfinite(variance), variance, 0.0)
        return directions @ (finite * (directions.T @ self.information))

    @property
    def deviation(self) -> FloatArray:
        """(K,): standard deviation of each coefficient."""
        variance, directions = self._modes
        share = np.where(directions**2 > _RANK_TOLERANCE, directions**2, 0.0)
        return np.sqrt(np.sum(np.multiply(share, variance, out=share, where=share > 0), axis=1))


def principal_directions(
    deviations: FloatArray, most: int | None = None, *, size: float, part: Any = ...
) -> tuple[FloatArray, float]:
    """Return the directions (N, ...) of most variance among deviations X (K, ...), and all their variance.

    X X^T = U diag(e) U^T; direction i is X^T u_i / sqrt(K - 1), the largest entry of u_i positive. Rounding,
    of X and of values whose squares sum to `size`, is left out: N is at most the rank, K - 1, and `most`. An
    index `part` into the last axes says whose variance counts.
    """
    count = len(deviations)
    rows = deviations[part].reshape(count, -1)
    values, vectors = np.linalg.eigh(rows @ rows.T)
    values = np.maximum(values[::-1], 0.0)
    vectors = vectors[:, ::-1]
    rank = int((values > max(_RANK_TOLERANCE * values[0], _ROUNDING * count * size)).sum())
    kept = min(rank, count - 1, count if most is None else most)
    sign = np.where(vectors[np.abs(vectors).argmax(0), np.arange(count)] < 0, -1.0, 1.0)
    spread = max(count - 1, 1)
    weights = (vectors * sign)[:, :kept].T / np.sqrt(spread)
    return np.tensordot(weights, deviations, 1), float(values.sum() / spread)
