"""Shared by models learned from samples: means over gaps, principal directions, coefficients."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.errors import ReflectanceError
from scan2albedo.reflectance.vertex_reflectance import VertexReflectance

_RANK_TOLERANCE = 1e-12
"""Eigenvalues below this share of the largest are rounding."""
_PEOPLE_DIFFER = 0.2
"""Standard deviation of an albedo among people, as part of its level."""
_ROUNDING = 1e-28
"""And those below this share of the squared values themselves."""


@dataclass(frozen=True)
class SampleStack:
    """K samples of V vertices as arrays; zero where they are not known."""

    diffuse: FloatArray
    """(K, V, 3)."""
    total: FloatArray
    """(K, V) s, the sum of the weights."""
    share: FloatArray
    """(K, V, 3) w' = w / s."""
    known: BoolArray
    """(K, V)."""
    shared: BoolArray
    """(K, V): known with s > 0, for w' is not defined without a lobe."""


def stack_samples(samples: Sequence[VertexReflectance]) -> SampleStack:
    """Return samples of one topology as arrays; raises `ReflectanceError` for none, or several topologies."""
    if not samples:
        raise ReflectanceError("there is no sample to learn from; give one or more")
    sizes = [len(sample.known) for sample in samples]
    if len(set(sizes)) > 1:
        odd = next(k for k, size in enumerate(sizes) if size != sizes[0])
        raise ReflectanceError(
            f"sample {odd} has {sizes[odd]} vertices and sample 0 has {sizes[0]}; bring all to one topology"
        )
    known = np.stack([sample.known for sample in samples])
    diffuse = np.where(known[..., None], np.stack([s.diffuse_linear for s in samples]), 0.0)
    weights = np.where(known[..., None], np.stack([s.weights for s in samples]), 0.0)
    total = weights.sum(2)
    share = np.divide(weights, total[..., None], out=np.zeros_like(weights), where=total[..., None] > 0)
    return SampleStack(diffuse, total, share, known, known & (total > 0))


def reliability(sample: VertexReflectance, std: FloatArray | None) -> FloatArray:
    """Return (V,) the weight of each vertex of a sample: t^2 / (t^2 + s^2), 0 where it is not known.

    s is the largest of the standard deviations of its albedos, columns of `std` (V, 6), and t how much people
    differ, a part of the sample's median albedo. Without `std` all that is known counts fully.
    """
    weight = sample.known.astype(np.float64)
    if std is not None and sample.known.any():
        differ = _PEOPLE_DIFFER * float(np.median(sample.diffuse_linear[sample.known]))
        square = np.nan_to_num(std[:, :3]).max(1) ** 2
        weight *= differ**2 / np.maximum(differ**2 + square, 1e-300)
    return weight


def mean_and_deviations(
    values: FloatArray, weight: FloatArray, otherwise: float
) -> tuple[FloatArray, FloatArray]:
    """Return the mean (V, ...) of samples of `weight` (K, V), and weighted deviations (K, V, ...).

    The weight is 0 at gaps; the mean is `otherwise` where no sample knows the vertex.
    """
    part = weight.reshape(weight.shape + (1,) * (values.ndim - 2))
    total = part.sum(0)
    mean = np.where(total > 0, (values * part).sum(0) / np.where(total > 0, total, 1.0), otherwise)
    return mean, part * (values - mean)


@dataclass(frozen=True)
class PrincipalDirections:
    """N directions of K samples, as sums of their deviations from the mean."""

    weights: FloatArray
    """(N, K): of the samples' deviations in each direction of unit variance."""
    deviation: FloatArray
    """(N,) standard deviations of the samples along them, largest first."""
    total_variance: float

    def of(self, deviations: FloatArray) -> FloatArray:
        """Return the directions (N, ...) of deviations (K, ...)."""
        return np.asarray(np.tensordot(self.weights, deviations, 1))


def principal_directions(deviations: FloatArray, most: int | None, *, size: float) -> PrincipalDirections:
    """Return the directions in which deviations X (K, ...) vary most.

    X X^T = U diag(e) U^T; direction i is X^T u_i / sqrt(K - 1), the largest entry of u_i positive. Rounding,
    of X and of values whose squares sum to `size`, is left out: N is at most the rank, K - 1, and `most`.
    """
    count = len(deviations)
    rows = deviations.reshape(count, -1)
    values, vectors = np.linalg.eigh(rows @ rows.T)
    values, vectors = np.maximum(values[::-1], 0.0), vectors[:, ::-1]
    rank = int((values > max(_RANK_TOLERANCE * values[0], _ROUNDING * count * size)).sum())
    kept = min(rank, count - 1, count if most is None else most)
    largest = np.abs(vectors).argmax(0)
    sign = np.where(vectors[largest, np.arange(count)] < 0, -1.0, 1.0)
    spread = max(count - 1, 1)
    weights = (vectors * sign)[:, :kept].T / np.sqrt(spread)
    return PrincipalDirections(weights, np.sqrt(values[:kept] / spread), float(values.sum() / spread))


def checked_coefficients(values: ArrayLike, count: int, name: str) -> FloatArray:
    """Return coefficients as (count,), or raise `ValueError` for the shape, `ReflectanceError` for NaN."""
    coefficients = np.array(values, np.float64)
    if coefficients.shape != (count,):
        raise ValueError(f"{name} must have shape ({count},), got {coefficients.shape}")
    if not np.isfinite(coefficients).all():
        raise ReflectanceError(f"{name} must be finite, got NaN or infinite values")
    return coefficients
