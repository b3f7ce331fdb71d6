"""`MorphableReflectanceModel`: faces' reflectance as a mean and a few directions of change."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import BaseModel, ConfigDict, Field

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray, checked_array
from scan2albedo.errors import ReflectanceError, errors_of
from scan2albedo.io.npz import read_npz_record, write_npz_record
from scan2albedo.reflectance.linear_model import LinearModel, principal_directions, require_one_topology
from scan2albedo.reflectance.vertex_reflectance import EXPONENTS, VertexReflectance, check_exponents

PEOPLE_DIFFER = 0.2
"""Standard deviation of an albedo among people, as part of its level."""
_PARTS = {"diffuse": "diffuse", "total": "sum", "share": "share"}
"""The model's fields, and what the names of their arrays begin with in its file."""
_KINDS = {"known": "b", "support": "iu", "deviation": "f"} | {
    f"{part}_{array}": "f" for part in _PARTS.values() for array in ("mean", "basis")
}


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
    coefficients: FloatArray
    """(N,)."""
    clipped_share: float
    """Of the numbers of known vertices (six each) that were negative and became 0 in `reflectance`."""


@dataclass(frozen=True)
class MorphableReflectanceModel:
    """Reflectance c, w = s w' of V vertices, linear in N coefficients b of unit variance.

        c = c0 + sum b_i C_i,   s = s0 + sum b_i S_i,   w' = w'0 + sum b_i W_i.

    After Han, Wang, Xu, supplement. Raises `ReflectanceError` when shapes disagree or a number is not finite.
    """

    known: BoolArray
    """(V,): vertices the model knows; arrays hold zeros elsewhere."""
    support: IntArray
    """(V,): samples that know each vertex."""
    diffuse: LinearModel
    """Of c, (V, 3)."""
    total: LinearModel
    """Of s, (V,)."""
    share: LinearModel
    """Of w', (V, 3): the shares sum to 1 and their directions to 0."""
    total_variance: float
    """Of the samples' albedo, all directions and vertices together."""
    samples: int
    """K."""

    def __post_init__(self) -> None:
        count = len(self.known)
        checked_array(self.support, (count,), "reflectance model: support", ReflectanceError, kind=int)
        for part, name in _PARTS.items():
            one: LinearModel = getattr(self, part)
            one.check(f"reflectance model: {name}", (count,) if part == "total" else (count, 3))
            if one.components != self.components:
                raise ReflectanceError(
                    f"reflectance model: {name} basis has {one.components} directions, expected "
                    f"{self.components} as diffuse basis"
                )

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
        trust = (there & known).astype(np.float64)
        if weights is not None:
            given = np.asarray([np.asarray(one, np.float64) for one in weights])
            if given.shape != there.shape or not ((given >= 0) & (given <= 1)).all():
                raise ValueError(f"weights must be 0 to 1, of shape {there.shape}, got {given.shape}")
            trust *= given
        diffuse = np.where(there[..., None], np.stack([one.diffuse_linear for one in samples]), 0.0)
        lobes = np.where(there[..., None], np.stack([one.weights for one in samples]), 0.0)
        total = lobes.sum(2)
        share = np.divide(lobes, total[..., None], out=np.zeros_like(lobes), where=total[..., None] > 0)
        mean, off = _mean_and_deviations(diffuse, trust, 0.0)
        directions, total_variance = principal_directions(off, components, size=float(np.sum(mean**2)))
        sum_mean, sum_off = _mean_and_deviations(total, trust, 0.0)
        share_mean, share_off = _mean_and_deviations(share, trust * (there & (total > 0)), 1 / 3)
        means = mean, sum_mean, np.where(known[:, None], share_mean, 0.0)
        changes = (np.tensordot(directions, one, 1) for one in (off, sum_off, share_off))
        albedo, gloss, shares = map(LinearModel, means, changes)
        return cls(known, support.astype(np.int64), albedo, gloss, shares, total_variance, len(samples))

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
        found = arrays["deviation"].shape, arrays["known"].shape
        if found != ((header.components,), (header.vertices,)):
            raise ReflectanceError(
                f"reflectance model {path}: its header says {header.components} components of "
                f"{header.vertices} vertices, the arrays are {found[0]} and {found[1]}; write the file again"
            )
        diffuse, total, share = (
            LinearModel(*(arrays[f"{name}_{array}"].astype(np.float64) for array in ("mean", "basis")))
            for name in _PARTS.values()
        )
        known, support = arrays["known"], arrays["support"]
        with errors_of(str(path), ReflectanceError, advice="write the file again"):
            return cls(known, support, diffuse, total, share, header.total_variance, header.samples)

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
        for part, name in _PARTS.items():
            arrays |= {f"{name}_mean": getattr(self, part).mean, f"{name}_basis": getattr(self, part).basis}
        write_npz_record(path, header, arrays, what="reflectance model")

    @property
    def components(self) -> int:
        """N, the number of coefficients."""
        return self.diffuse.components

    @property
    def deviation(self) -> FloatArray:
        """(N,): standard deviation of the samples' albedo along each direction; largest first."""
        return self.diffuse.deviation

    @property
    def explained(self) -> FloatArray:
        """(N,) shares of the albedo's variance that the directions hold one by one."""
        return self.deviation**2 / max(self.total_variance, np.finfo(float).tiny)

    def mean_only(self, factors: ArrayLike = 1.0) -> Self:
        """Return the model without its directions, with factors (3,) on the channels of the mean albedo."""
        parts = self.diffuse, self.total, self.share
        diffuse, total, share = (LinearModel(part.mean, part.basis[:0]) for part in parts)
        diffuse = replace(diffuse, mean=diffuse.mean * np.asarray(factors))
        return replace(self, diffuse=diffuse, total=total, share=share)

    def reconstruct(self, coefficients: ArrayLike) -> ModelReflectance:
        """Return the reflectance of coefficients (N,), negatives set to 0 and counted.

        Raises `ValueError` when there are not N, `ReflectanceError` when one is not finite.
        """
        diffuse, total, share = (part.at(coefficients) for part in (self.diffuse, self.total, self.share))
        total = total[:, None]
        rounding = -1e-9
        negative = (diffuse < rounding).astype(int) + ((total < rounding) | (share < rounding))
        weights = np.maximum(total, 0) * np.maximum(share, 0)
        return ModelReflectance(
            VertexReflectance(np.maximum(diffuse, 0), weights, self.known),
            np.array(coefficients, np.float64),
            float(negative[self.known].sum()) / max(6 * int(self.known.sum()), 1),
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
        basis = self.diffuse.basis[:, common].reshape(self.components, 3 * int(common.sum()))
        off = (reflectance.diffuse_linear[common] - self.diffuse.mean[common]).ravel()
        normal = basis @ basis.T + prior * np.eye(self.components)
        return self.reconstruct(np.linalg.lstsq(normal, basis @ off, rcond=1e-12)[0])


def _mean_and_deviations(
    values: FloatArray, weight: FloatArray, otherwise: float
) -> tuple[FloatArray, FloatArray]:
    """Return the mean (V, ...) by `weight` (K, V), else `otherwise`, and weighted deviations."""
    part = weight.reshape(weight.shape + (1,) * (values.ndim - 2))
    total = part.sum(0)
    mean = np.where(total > 0, (values * part).sum(0) / np.where(total > 0, total, 1.0), otherwise)
    return mean, part * (values - mean)


def reliability(sample: VertexReflectance, std: FloatArray | None) -> FloatArray:
    """Return (V,) the weight of each vertex of a sample: t^2 / (t^2 + s^2), 0 where it is not known.

    s is the largest of the standard deviations of its albedos, columns of `std` (V, 6), and t how much people
    differ, a part of the sample's median albedo. Without `std` all that is known counts fully.
    """
    weight = sample.known.astype(np.float64)
    if std is not None and sample.known.any():
        differ = PEOPLE_DIFFER * float(np.median(sample.diffuse_linear[sample.known]))
        square = np.nan_to_num(std[:, :3]).max(1) ** 2
        weight *= differ**2 / np.maximum(differ**2 + square, np.finfo(float).tiny)
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
    size, deviation, errors = 3 * int(model.known.sum()), model.deviation, np.zeros(len(counts))
    for sample in samples[4::5]:
        both = model.known & sample.known
        off = np.where(both[:, None], sample.diffuse_linear - model.diffuse.mean, 0.0)
        for given in (first, ~first):
            seen, hidden = np.flatnonzero(both & given), np.flatnonzero(both & ~given)
            basis = model.diffuse.basis[:, seen].reshape(model.components, -1)
            gram, towards = basis @ basis.T, basis @ off[seen].ravel()
            for number, count in enumerate(counts):
                left = max(model.total_variance - float(np.sum(deviation[:count] ** 2)), 0.0)
                noise = max(left, 1e-9 * model.total_variance) / size
                b = np.linalg.solve(gram[:count, :count] + noise * np.eye(count), towards[:count])
                made = np.tensordot(b, model.diffuse.basis[:count, hidden], 1)
                errors[number] += np.sum((made - off[hidden]) ** 2)
    return counts[int(np.argmax(errors <= 1.01**2 * errors.min()))]
