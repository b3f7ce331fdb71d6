"""`MorphableReflectanceModel`: faces' reflectance as a mean and a few directions of change."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Self

import numpy as np
from pydantic import ConfigDict, Field

from scan2albedo.core.arrays import (
    SMALLEST,
    ArrayLike,
    BoolArray,
    FloatArray,
    IntArray,
    Values,
    checked_array,
)
from scan2albedo.errors import ReflectanceError, errors_of
from scan2albedo.io.npz import read_npz_record, write_npz_record
from scan2albedo.io.records import Count, PositiveCount, Record
from scan2albedo.reflectance.vertex_reflectance import (
    EXPONENTS,
    VertexReflectance,
    check_exponents,
    require_one_topology,
)
from scan2albedo.statistics.linear_model import LinearModel, principal_directions

PEOPLE_DIFFER = 0.2
"""Standard deviation of an albedo among people, as part of its level."""
_PARTS: Values = {"diffuse": slice(0, 3), "sum": 3, "share": slice(4, 7)}
"""The model's columns by what the names of their arrays begin with in its file."""
_KINDS = {"known": "b", "support": "iu", "deviation": "f"} | {
    f"{part}_{array}": "f" for part in _PARTS for array in ("mean", "basis")
}


class ReflectanceModelHeader(Record):
    """The text "header" in a file of a morphable reflectance model, as JSON.

    The file also holds known (V,), support (V,), diffuse_mean (V, 3), diffuse_basis (N, V, 3), sum_mean (V,),
    sum_basis (N, V), share_mean (V, 3), share_basis (N, V, 3) and deviation (N,).
    """

    model_config = ConfigDict(title="scan2albedo morphable reflectance model")

    format: Literal["scan2albedo reflectance model"] = "scan2albedo reflectance model"
    format_version: Literal[1] = 1
    exponents: tuple[float, float, float] = Field(description="Of the Blinn-Phong lobes, in their order.")
    samples: PositiveCount = Field(description="K, reflectances the model was learned from.")
    vertices: PositiveCount = Field(description="V.")
    components: Count = Field(description="N, directions of change.")
    total_variance: float = Field(ge=0, description="Of the samples' albedo, all vertices together.")


@dataclass(frozen=True)
class ModelReflectance:
    """A reflectance that a model made."""

    reflectance: VertexReflectance
    coefficients: FloatArray
    """(N,)."""
    clipped_share: float
    """Of the numbers of known vertices (six each) that were negative and became 0 in `reflectance`."""


@dataclass(frozen=True, eq=False)
class MorphableReflectanceModel(LinearModel):
    """Reflectance c, w = s w' of V vertices, linear in N coefficients b of unit variance.

        c = c0 + sum b_i C_i,   s = s0 + sum b_i S_i,   w' = w'0 + sum b_i W_i.

    `mean` (V, 7) and `basis` (N, V, 7) have the columns c, s, w'; the shares w' sum to 1 and their directions
    to 0. After Han, Wang, Xu, supplement. Raises `ReflectanceError` when shapes disagree or a number is not
    finite.
    """

    error = ReflectanceError

    known: BoolArray
    """(V,): vertices the model knows; arrays hold zeros elsewhere."""
    support: IntArray
    """(V,): samples that know each vertex."""
    total_variance: float
    """Of the samples' albedo, all directions and vertices together."""
    samples: int
    """K."""

    def __post_init__(self) -> None:
        count = len(self.known)
        checked_array(self.support, (count,), "reflectance model: support", ReflectanceError, kind=int)
        self.require_shape("reflectance model:", (count, 7))

    @classmethod
    def from_samples(
        cls,
        samples: Sequence[VertexReflectance],
        *,
        components: int | None = None,
        least_support: float = 0.5,
        weights: Sequence[ArrayLike] | None = None,
    ) -> Self:
        """Learn a model from K reflectances of one topology.

        The directions are those of the albedo's deviations from its mean (`principal_directions`); the
        deviations of s and w' are summed with the same weights. Raises `ReflectanceError` when there is no
        sample, topologies differ, or no vertex has the support; `ValueError` for options out of range.

        Parameters
        ----------
        samples : sequence of VertexReflectance
            K, one or more. One gives a model that is its mean; identical ones give no direction. Where one
            does not know a vertex, it is taken to be the mean of those that do.
        components : int, optional
            Directions to keep; all, at most K - 1, when omitted.
        least_support : float
            Share of the samples, above 0, that must know a vertex for the model to know it.
        weights : sequence of (V,) array_like of float, optional
            Of each sample's vertices, 0 to 1: the mean is weighted, deviations are multiplied by them.
        """
        if components is not None and components < 0:
            raise ValueError(f"components must be 0 or more, got {components}")
        if not 0 < least_support <= 1:
            raise ValueError(f"least_support must be above 0 and at most 1, got {least_support}")
        if not samples:
            raise ReflectanceError("there is no sample to learn from; give one or more")
        for k, sample in enumerate(samples):
            require_one_topology(f"sample {k}", len(sample.known), "sample 0", len(samples[0].known))
        there = np.stack([sample.known for sample in samples])
        support = there.sum(0)
        known = support >= np.ceil(least_support * len(samples) - 1e-9)
        if not known.any():
            raise ReflectanceError(
                f"no vertex is known to {100 * least_support:.0f} % of the {len(samples)} samples; give more "
                "complete ones or a smaller least_support"
            )
        trust = (there & known).astype(float)
        if weights is not None:
            weight_values = np.asarray([np.asarray(one, float) for one in weights])
            if weight_values.shape != there.shape or not ((weight_values >= 0) & (weight_values <= 1)).all():
                raise ValueError(f"weights must be 0 to 1, of shape {there.shape}, got {weight_values.shape}")
            trust *= weight_values
        values = np.stack([_columns(one) for one in samples])
        # Without gloss there are no shares of it; where nobody has any, they are equal.
        weight = np.repeat(trust[..., None], 7, axis=2)
        weight[..., 4:] *= values[..., 3:4] > 0
        sure, equal = weight.sum(0), np.repeat([0.0, 1 / 3], [4, 3])
        mean = np.where(sure > 0, (values * weight).sum(0) / np.where(sure > 0, sure, 1.0), equal)
        off = weight * (values - mean)
        mean = np.where(known[:, None], mean, 0.0)
        size = np.sum(mean[:, :3] ** 2)
        basis, total_variance = principal_directions(off, components, size=size, part=np.s_[..., :3])
        return cls(mean, basis, known, support.astype(int), total_variance, len(samples))

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a model that `save` wrote; raises `ReflectanceError`, naming the file, for anything else."""
        header, arrays = read_npz_record(
            path,
            ReflectanceModelHeader,
            _KINDS,
            what="reflectance model",
            advice="give a file that its `save` wrote (data_schemas/reflectance_model.schema.json)",
            error=ReflectanceError,
        )
        check_exponents(header.exponents, f"reflectance model {path}")
        owner, advice = f"reflectance model {path}", "write the file again"
        with errors_of(owner, ReflectanceError, ValueError, advice=advice):
            mean, basis = (
                np.concatenate(
                    [arrays[f"diffuse_{a}"], arrays[f"sum_{a}"][..., None], arrays[f"share_{a}"]], -1
                )
                for a in ("mean", "basis")
            )
            checked_array(arrays["deviation"], (header.components,), "deviation", ReflectanceError)
            basis = checked_array(basis, (header.components, header.vertices, 7), "basis", ReflectanceError)
            more = arrays["known"], arrays["support"], header.total_variance, header.samples
            return cls(mean.astype(float), basis, *more)

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
        arrays = {"known": self.known, "support": self.support, "deviation": self.deviation}
        for name, columns in _PARTS.items():
            arrays |= {f"{name}_mean": self.mean[..., columns], f"{name}_basis": self.basis[..., columns]}
        write_npz_record(path, header, arrays, what="reflectance model")

    @property
    def diffuse(self) -> LinearModel:
        """Of the albedo c alone, (V, 3)."""
        return self.of(np.s_[:, :3])

    @property
    def deviation(self) -> FloatArray:
        """(N,): standard deviation of the samples' albedo along each direction; largest first."""
        return self.diffuse.deviation

    @property
    def explained(self) -> FloatArray:
        """(N,) shares of the albedo's variance that the directions hold one by one."""
        return self.deviation**2 / max(self.total_variance, SMALLEST)

    def mean_only(self, factors: ArrayLike = 1.0) -> Self:
        """Return the model without its directions, with factors (3,) on the channels of the mean albedo."""
        tinted = self.mean * np.append(np.broadcast_to(factors, 3), np.ones(4))
        return replace(self, mean=tinted, basis=self.basis[:0])

    @property
    def mean_reflectance(self) -> VertexReflectance:
        """Of V vertices: that of the mean face."""
        return self.reconstruct(np.zeros(self.components)).reflectance

    def reconstruct(self, coefficients: ArrayLike) -> ModelReflectance:
        """Return the reflectance of coefficients (N,), negatives set to 0 and counted.

        Raises `ValueError` when there are not N, `ReflectanceError` when one is not finite.
        """
        diffuse, total, share = np.split(self.at(coefficients), [3, 4], axis=1)
        rounding = -1e-9
        negative = (diffuse < rounding).astype(int) + ((total < rounding) | (share < rounding))
        weights = np.maximum(total, 0) * np.maximum(share, 0)
        return ModelReflectance(
            VertexReflectance(np.maximum(diffuse, 0), weights, self.known),
            np.array(coefficients, float),
            float(negative[self.known].sum()) / max(6 * self.known.sum(), 1),
        )

    def sample(self, seed: int | np.random.Generator = 0, *, scale: float = 1.0) -> ModelReflectance:
        """Return a reflectance of normal random coefficients with standard deviation `scale`."""
        return self.reconstruct(scale * np.random.default_rng(seed).normal(size=self.components))

    def project(self, reflectance: VertexReflectance, *, prior: float = 0.0) -> ModelReflectance:
        """Return the reflectance of the model whose albedo is nearest, over vertices known to both.

        Minimises sum |c - c0 - sum b_i C_i|^2 + prior |b|^2; the weights follow b. Use a prior above 0 when
        few vertices are known. Raises `ReflectanceError` when the topology is another, or no vertex is known
        to both; `ValueError` when `prior` is negative.
        """
        if not prior >= 0:
            raise ValueError(f"prior must be 0 or more, got {prior}")
        require_one_topology("the reflectance", len(reflectance.known), "the model", len(self.known))
        common = self.known & reflectance.known
        if not common.any():
            raise ReflectanceError("no vertex is known to both the model and the reflectance")
        nearest = self.of(np.s_[common, :3]).fit(reflectance.diffuse_linear[common], prior=prior)
        return self.reconstruct(nearest.mean)


def _columns(sample: VertexReflectance) -> FloatArray:
    """Return a sample's c, s and w' (V, 7); 0 where it is not known, and shares of no gloss are 0."""
    numbers = np.concatenate([sample.diffuse_linear, sample.weights], axis=1)
    diffuse, lobes = np.split(np.where(sample.known[:, None], numbers, 0.0), 2, axis=1)
    total = lobes.sum(1, keepdims=True)
    share = np.divide(lobes, total, out=np.zeros_like(lobes), where=total > 0)
    return np.concatenate([diffuse, total, share], axis=1)


def reliability(sample: VertexReflectance, std: FloatArray | None) -> FloatArray:
    """Return (V,) the weight of each vertex of a sample: t^2 / (t^2 + s^2), 0 where it is not known.

    s is the largest of the standard deviations of its albedos, columns of `std` (V, 6), and t how much people
    differ, a part of the sample's median albedo. Without `std` all that is known counts fully.
    """
    weight = sample.known.astype(float)
    if std is not None and sample.known.any():
        differ = PEOPLE_DIFFER * np.median(sample.diffuse_linear[sample.known])
        square = np.nan_to_num(std[:, :3]).max(1) ** 2
        weight *= differ**2 / np.maximum(differ**2 + square, SMALLEST)
    return weight


def held_out_components(samples: Sequence[VertexReflectance], vertices: ArrayLike) -> int:
    """Return the fewest directions that predict one half of people's faces from the other half well.

    A model is learned from four of five samples. Of each other face, every second block of 25 mm gives the
    most probable coefficients, with what the kept directions leave out as noise, and the albedo of the other
    blocks is compared. The fewest directions are taken whose error (RMS) is within 1 % of the least.
    `vertices` (V, 3), mm, are those of any of the faces. Raises `ReflectanceError` for fewer than 10 samples
    or another number of vertices.
    """
    if len(samples) < 10:
        raise ReflectanceError(f"{len(samples)} samples are too few to choose directions; give 10 or more")
    model = MorphableReflectanceModel.from_samples([one for k, one in enumerate(samples) if k % 5 != 4])
    xyz = checked_array(vertices, (len(model.known), 3), "vertices", ReflectanceError)
    # Neighbouring cubes differ in this sum by one, so that they fall into different halves.
    first = np.floor(xyz / 25).sum(1) % 2 == 0
    tried = (0, 1, 2, 3, 5, 8, 12, 18, 27, 40, 60, 90, 135, 200, 300)
    counts = [count for count in tried if count < model.components] + [model.components]
    errors = np.zeros(len(counts))
    for number, count in enumerate(counts):
        kept = replace(model.diffuse, basis=model.diffuse.basis[:count])
        left_out = model.total_variance - np.sum(kept.deviation**2)
        noise = max(left_out, 1e-9 * model.total_variance) / (3 * model.known.sum())
        for sample in samples[4::5]:
            both = model.known & sample.known
            for half in (first, ~first):
                seen = both & half
                hidden = both & ~half
                b = kept.of(seen).fit(sample.diffuse_linear[seen], prior=noise).mean
                errors[number] += np.sum((kept.of(hidden).at(b) - sample.diffuse_linear[hidden]) ** 2)
    return counts[np.argmax(errors <= 1.01**2 * errors.min())]
