"""`MorphableReflectanceModel`: faces' reflectance as a mean and a few directions of change."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import BaseModel, ConfigDict, Field

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.errors import ReflectanceError
from scan2albedo.io.npz import read_npz_record, write_npz_record
from scan2albedo.reflectance.sample_statistics import (
    checked_coefficients,
    mean_and_deviations,
    principal_directions,
    stack_samples,
)
from scan2albedo.reflectance.vertex_reflectance import EXPONENTS, VertexReflectance, check_exponents

_CLIP_TOLERANCE = 1e-9
"""Negatives smaller than this are rounding and not counted."""
_ARRAYS: dict[str, tuple[str, tuple[str | int, ...]]] = {
    "known": ("b", ("V",)),
    "support": ("iu", ("V",)),
    "diffuse_mean": ("f", ("V", 3)),
    "diffuse_basis": ("f", ("N", "V", 3)),
    "sum_mean": ("f", ("V",)),
    "sum_basis": ("f", ("N", "V")),
    "share_mean": ("f", ("V", 3)),
    "share_basis": ("f", ("N", "V", 3)),
    "deviation": ("f", ("N",)),
}
"""Names of the arrays, in the model and in its file, with their kinds and shapes."""


class ReflectanceModelHeader(BaseModel):
    """The text "header" in a file of a morphable reflectance model, as JSON.

    The file also holds known (V,), support (V,), diffuse_mean (V, 3), diffuse_basis (N, V, 3), sum_mean (V,),
    sum_basis (N, V), share_mean (V, 3), share_basis (N, V, 3) and deviation (N,).
    """

    model_config = ConfigDict(extra="forbid", frozen=True, title="scan2albedo morphable reflectance model")

    format: Literal["scan2albedo reflectance model"] = "scan2albedo reflectance model"
    format_version: Literal[1] = 1
    exponents: tuple[float, float, float] = Field(description="Of the Blinn-Phong lobes, in their order.")
    samples: int = Field(ge=1, description="K, reflectances the model was learned from.")
    vertices: int = Field(ge=1, description="V.")
    components: int = Field(ge=0, description="N, directions of change.")
    total_variance: float = Field(ge=0, description="Of the samples' albedo, all vertices together.")


@dataclass(frozen=True)
class ModelReflectance:
    """A reflectance that a model made."""

    reflectance: VertexReflectance
    """Of the vertices that the model knows."""
    coefficients: FloatArray
    """(N,)."""
    clipped_diffuse: int
    """Numbers of the albedo (three a vertex) that were negative and became 0."""
    clipped_weights: int
    """Numbers of the weights (three a vertex) of which s or w' was negative; they became 0."""

    @property
    def clipped_share(self) -> float:
        """Clipped numbers over all numbers of known vertices."""
        return (self.clipped_diffuse + self.clipped_weights) / max(6 * int(self.reflectance.known.sum()), 1)


@dataclass(frozen=True)
class Projection:
    """The nearest reflectance of a model."""

    nearest: ModelReflectance
    """And its coefficients."""
    diffuse_rmse: float
    """Of the albedo, over vertices known on both sides."""
    weights_rmse: float
    """Of the weights, which follow the albedo's coefficients."""


@dataclass(frozen=True)
class MorphableReflectanceModel:
    """Reflectance c, w = s w' of V vertices, linear in N coefficients b of unit variance.

        c = c0 + sum b_i C_i,   s = s0 + sum b_i S_i,   w' = w'0 + sum b_i W_i.

    After Han, Wang, Xu, supplement. Raises `ReflectanceError` when shapes disagree or a number is not finite.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> numbers = rng.uniform(0.1, 0.6, (4, 2, 50, 3))
    >>> faces = [VertexReflectance(diffuse, weights, np.ones(50, bool)) for diffuse, weights in numbers]
    >>> model = MorphableReflectanceModel.from_samples(faces)
    >>> model.components
    3
    >>> model.project(faces[2]).diffuse_rmse < 1e-12
    True
    """

    known: BoolArray
    """(V,): vertices the model knows; arrays hold zeros elsewhere."""
    support: IntArray
    """(V,): samples that know each vertex."""
    diffuse_mean: FloatArray
    diffuse_basis: FloatArray
    """`diffuse_mean`, `diffuse_basis`: (V, 3), (N, V, 3)."""
    sum_mean: FloatArray
    sum_basis: FloatArray
    """`sum_mean`, `sum_basis`: (V,), (N, V)."""
    share_mean: FloatArray
    share_basis: FloatArray
    """`share_mean`, `share_basis`: (V, 3), (N, V, 3): the shares sum to 1 and their directions to 0."""
    deviation: FloatArray
    """(N,): standard deviation of the samples' albedo along each direction; largest first."""
    total_variance: float
    """Of the samples' albedo, all directions and vertices together."""
    samples: int
    """K."""

    def __post_init__(self) -> None:
        sizes: dict[str | int, int] = {"V": len(self.known), "N": len(self.deviation)}
        for name, (_, axes) in _ARRAYS.items():
            shape = tuple(sizes.get(axis, axis) for axis in axes)
            array = getattr(self, name)
            if array.shape != shape:
                raise ReflectanceError(f"reflectance model: {name} is {array.shape}, expected {shape}")
            if not np.isfinite(array).all():
                raise ReflectanceError(f"reflectance model: {name} holds NaN or infinite values")

    @classmethod
    def from_samples(
        cls,
        samples: Sequence[VertexReflectance],
        *,
        components: int | None = None,
        least_support: float = 0.5,
        weights: Sequence[ArrayLike] | None = None,
    ) -> MorphableReflectanceModel:
        """Learn a model from K reflectances of one topology.

        The deviations X (K x 3V) of the albedo from its mean have the Gram matrix X X^T = U diag(e) U^T;
        direction i is X^T u_i / sqrt(K - 1), and the deviations of s and w' use the same u_i.

        Raises `ReflectanceError` when there is no sample, topologies differ, or no vertex has the support;
        `ValueError` for options out of range.

        Parameters
        ----------
        samples : sequence of VertexReflectance
            K, one or more. One gives a model that is its mean; identical ones give no direction.
        components : int, optional
            Directions to keep; all, at most K - 1, when omitted.
        least_support : float
            Share of the samples, above 0, that must know a vertex for the model to know it.
        weights : sequence of (V,) array_like of float, optional
            Of each sample's vertices, 0 to 1: the mean is weighted, deviations are multiplied by them.

        Notes
        -----
        Where a sample does not know a vertex, it is taken to be the mean of those that do. This adds
        no direction of its own, but the variance there comes out too small, by about the share of samples
        missing (see `support`). w' of a vertex without a lobe is a gap too, since 0 / 0 is no share. How
        weights vary where the albedo does not is left out, for directions are those of the albedo.

        Cost: K^2 V, memory 7 K V numbers.
        """
        if components is not None and components < 0:
            raise ValueError(f"components must be 0 or more, got {components}")
        if not 0 < least_support <= 1:
            raise ValueError(f"least_support must be above 0 and at most 1, got {least_support}")
        stack = stack_samples(samples)
        support = stack.known.sum(0)
        known = support >= np.ceil(least_support * len(samples) - 1e-9)
        if not known.any():
            raise ReflectanceError(
                f"no vertex is known to {100 * least_support:.0f} % of the {len(samples)} samples; give more "
                "complete ones or a smaller least_support"
            )
        trust = (stack.known & known) * _checked_weights(weights, stack.known.shape)
        diffuse, diffuse_off = mean_and_deviations(stack.diffuse, trust, 0.0)
        total, total_off = mean_and_deviations(stack.total, trust, 0.0)
        share, share_off = mean_and_deviations(stack.share, trust * stack.shared, 1 / 3)
        directions = principal_directions(diffuse_off, components, size=float(np.sum(diffuse**2)))
        return cls(
            known,
            support.astype(np.int64),
            diffuse,
            directions.of(diffuse_off),
            total,
            directions.of(total_off),
            np.where(known[:, None], share, 0.0),
            directions.of(share_off),
            directions.deviation,
            directions.total_variance,
            len(samples),
        )

    @classmethod
    def load(cls, path: str | Path) -> MorphableReflectanceModel:
        """Read a model that `save` wrote; raises `ReflectanceError`, naming the file, for anything else."""
        header, arrays = read_npz_record(
            path,
            ReflectanceModelHeader,
            {name: kind for name, (kind, _) in _ARRAYS.items()},
            what="reflectance model",
            advice="give a file that its `save` wrote (data_schemas/reflectance_model.schema.json)",
            error=ReflectanceError,
        )
        check_exponents(header.exponents, f"reflectance model {path}")
        found = arrays["deviation"].shape, arrays["known"].shape
        if found != ((header.components,), (header.vertices,)):
            raise ReflectanceError(
                f"reflectance model {path}: its header says {header.components} components of "
                f"{header.vertices} vertices, the arrays are {found[0]} and {found[1]}; write the file again"
            )
        try:
            return cls(**arrays, total_variance=header.total_variance, samples=header.samples)
        except ReflectanceError as error:
            raise ReflectanceError(f"{path}: {error}; write the file again") from error

    def save(self, path: str | Path) -> None:
        """Write the model as an .npz file, whole or not at all; same model, same bytes.

        Raises `ValueError` when the name does not end in .npz, `OutputError` when it cannot be written.
        """
        header = ReflectanceModelHeader(
            exponents=EXPONENTS,
            samples=self.samples,
            vertices=len(self.known),
            components=self.components,
            total_variance=self.total_variance,
        )
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        write_npz_record(path, header, arrays, what="reflectance model")

    @property
    def components(self) -> int:
        """N, the number of coefficients."""
        return len(self.deviation)

    @property
    def explained(self) -> FloatArray:
        """(N,) shares of the albedo's variance that the directions hold one by one."""
        return self.deviation**2 / max(self.total_variance, 1e-300)

    def reconstruct(self, coefficients: ArrayLike) -> ModelReflectance:
        """Return the reflectance of coefficients (N,), negatives set to 0 and counted.

        Raises `ValueError` when there are not N, `ReflectanceError` when one is not finite.
        """
        b = checked_coefficients(coefficients, self.components, "coefficients")
        diffuse = self.diffuse_mean + np.tensordot(b, self.diffuse_basis, 1)
        total = self.sum_mean + np.tensordot(b, self.sum_basis, 1)
        share = self.share_mean + np.tensordot(b, self.share_basis, 1)
        negative = (total[:, None] < -_CLIP_TOLERANCE) | (share < -_CLIP_TOLERANCE)
        return ModelReflectance(
            VertexReflectance(
                np.maximum(diffuse, 0), np.maximum(total, 0)[:, None] * np.maximum(share, 0), self.known
            ),
            b,
            int((diffuse[self.known] < -_CLIP_TOLERANCE).sum()),
            int(negative[self.known].sum()),
        )

    def sample(self, seed: int | np.random.Generator = 0, *, scale: float = 1.0) -> ModelReflectance:
        """Return a reflectance of normal random coefficients with standard deviation `scale`."""
        return self.reconstruct(scale * np.random.default_rng(seed).normal(size=self.components))

    def project(self, reflectance: VertexReflectance, *, prior: float = 0.0) -> Projection:
        """Return the reflectance of the model whose albedo is nearest, over vertices known to both.

        Minimises sum |c - c0 - sum b_i C_i|^2 + prior |b|^2; the weights follow b. Use a prior above 0 when
        few vertices are known.

        Raises `ReflectanceError` when the topology is another, or no vertex is known to both; `ValueError`
        when `prior` is negative.
        """
        if not prior >= 0:
            raise ValueError(f"prior must be 0 or more, got {prior}")
        if reflectance.known.shape != self.known.shape:
            raise ReflectanceError(
                f"the reflectance has {len(reflectance.known)} vertices and the model {len(self.known)}"
            )
        common = self.known & reflectance.known
        if not common.any():
            raise ReflectanceError("no vertex is known to both the model and the reflectance")
        basis = self.diffuse_basis[:, common].reshape(self.components, 3 * int(common.sum()))
        off = (reflectance.diffuse_linear[common] - self.diffuse_mean[common]).ravel()
        normal = basis @ basis.T + prior * np.eye(self.components)
        nearest = self.reconstruct(np.linalg.lstsq(normal, basis @ off, rcond=1e-12)[0])
        made = nearest.reflectance
        return Projection(
            nearest,
            _rms(made.diffuse_linear[common] - reflectance.diffuse_linear[common]),
            _rms(made.weights[common] - reflectance.weights[common]),
        )


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _checked_weights(weights: Sequence[ArrayLike] | None, shape: tuple[int, ...]) -> FloatArray:
    """Return weights (K, V), ones when there are none; raises `ValueError` for others than 0 to 1."""
    if weights is None:
        return np.ones(shape)
    given = np.asarray([np.asarray(one, np.float64) for one in weights])
    if given.shape != shape or not ((given >= 0) & (given <= 1)).all():
        raise ValueError(f"weights must be numbers from 0 to 1 of shape {shape}, got {given.shape}")
    return given
