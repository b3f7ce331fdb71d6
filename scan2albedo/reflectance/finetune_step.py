"""The change of a model's albedo and lobe sums that explains images best, vertex by vertex."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.geometry.mesh import adjacency
from scan2albedo.reflectance.image_fit import ImageFit
from scan2albedo.reflectance.image_observation import ImageObservation
from scan2albedo.reflectance.morphable_model import MorphableReflectanceModel

_BLOCK = 4096


@dataclass(frozen=True)
class ModelChange:
    """Additions to a model; zeros at vertices that it does not know."""

    diffuse_mean: FloatArray
    """(V, 3)."""
    diffuse_basis: FloatArray
    """(N, V, 3)."""
    sum_mean: FloatArray
    """(V,)."""
    sum_basis: FloatArray
    """(N, V)."""

    def toward(self, other: ModelChange, step: float) -> ModelChange:
        """Return the change a step of the way to another."""
        return ModelChange(
            *((1 - step) * mine + step * its for mine, its in zip(_arrays(self), _arrays(other), strict=True))
        )

    def applied(self, model: MorphableReflectanceModel) -> MorphableReflectanceModel:
        """Return the model with the change added."""
        basis = model.diffuse_basis + self.diffuse_basis
        variance = np.sum(basis**2, axis=(1, 2))
        return replace(
            model,
            diffuse_mean=model.diffuse_mean + self.diffuse_mean,
            diffuse_basis=basis,
            sum_mean=model.sum_mean + self.sum_mean,
            sum_basis=model.sum_basis + self.sum_basis,
            deviation=np.sqrt(variance),
            total_variance=model.total_variance + float(variance.sum() - np.sum(model.deviation**2)),
        )

    def smoothed(self, smooth: Callable[[FloatArray], FloatArray]) -> ModelChange:
        """Return the change with a smoother of columns (V, C) applied to each of its parts."""
        count = len(self.sum_mean)
        parts = [np.moveaxis(array, -2, 0) for array in (self.diffuse_mean, self.diffuse_basis)]
        parts += [np.moveaxis(array, -1, 0) for array in (self.sum_mean, self.sum_basis)]
        columns = [np.reshape(part, (count, math.prod(part.shape[1:]))) for part in parts]
        ends = np.cumsum([column.shape[1] for column in columns])[:-1]
        found = np.split(smooth(np.concatenate(columns, axis=1)), ends, axis=1)
        back = [column.reshape(part.shape) for column, part in zip(found, parts, strict=True)]
        diffuse = [np.ascontiguousarray(np.moveaxis(part, 0, -2)) for part in back[:2]]
        total = [np.ascontiguousarray(np.moveaxis(part, 0, -1)) for part in back[2:]]
        return ModelChange(diffuse[0], diffuse[1], total[0], total[1])


def neighbour_smoothing(count: int, faces: IntArray, steps: int) -> Callable[[FloatArray], FloatArray]:
    """Return a smoother: `steps` times, each vertex with neighbours moves half way to their mean."""
    links = adjacency(count, faces)
    degree = np.asarray(links.sum(1)).ravel()
    walk = sparse.diags(1 / np.maximum(degree, 1)) @ links + sparse.diags((degree == 0).astype(float))

    def smooth(columns: FloatArray) -> FloatArray:
        for _ in range(steps):
            columns = 0.5 * (columns + walk @ columns)
        return columns

    return smooth


def no_change(model: MorphableReflectanceModel) -> ModelChange:
    """Return a change of nothing."""
    return ModelChange(
        *(
            np.zeros_like(array)
            for array in (model.diffuse_mean, model.diffuse_basis, model.sum_mean, model.sum_basis)
        )
    )


def best_change(
    model: MorphableReflectanceModel,
    observations: Sequence[ImageObservation],
    fits: Sequence[ImageFit],
    *,
    mean_change: float,
    basis_change: float,
) -> ModelChange:
    """Return the most probable change of the model given the images, each vertex for itself.

    With b_i and L_i of image i held, its colours are linear in the change of the means c0, s0 and of the
    directions C, S. Changes of the means have a normal prior with standard deviation m = `mean_change`, a
    share of the mean albedo (of the mean s), those of the directions n = `basis_change` times that; the noise
    is that of each image's fit. With x_i = (1, n b_i), light d_ij on the diffuse part and h_ij on lobes w',
    rows (i, j) of a vertex have the covariance

        (x_i . x_i') (m_c^2 [j = j'] d_ij d_i'j' + m_s^2 h_ij h_i'j') + noise,

    a system of 3 M equations for M images, whatever the number of coefficients. Cost: V (3 M)^3 / 3; memory
    12 V M numbers and 9 M^2 a vertex in blocks. The `fits` may be those of another model with the same
    directions.
    """
    scores = np.stack([fit.face.coefficients for fit in fits])
    features = np.concatenate([np.ones((len(fits), 1)), basis_change * scores], axis=1)
    rows = [_image_rows(model, o, fit) for o, fit in zip(observations, fits, strict=True)]
    diffuse, specular, off, noise = (np.stack([row[k] for row in rows], axis=1) for k in range(4))
    of_diffuse = mean_change * float(model.diffuse_mean[model.known].mean())
    of_sum = mean_change * float(model.sum_mean[model.known].mean())
    by_diffuse, by_sum = of_diffuse**2 * diffuse, of_sum**2 * specular
    dual = _dual(features @ features.T, (of_diffuse * diffuse, of_sum * specular), off, noise)
    change = np.einsum("in,vij->nvj", features, by_diffuse * dual)
    of_lobes = np.einsum("in,vij->nv", features, by_sum * dual)
    return ModelChange(change[0], basis_change * change[1:], of_lobes[0], basis_change * of_lobes[1:])


def _image_rows(
    model: MorphableReflectanceModel, observation: ImageObservation, fit: ImageFit
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return (V, 3) light on the diffuse part, on lobes of sum 1, differences, and variances of noise.

    Rows that are not used are zero with variance 1, so that they have no effect.
    """
    used = np.flatnonzero(np.asarray(observation.seen) & model.known)
    response = observation.response(used)
    b = fit.face.coefficients
    share = model.share_mean[used] + np.tensordot(b, model.share_basis[:, used], 1)
    diffuse = response.diffuse @ fit.light
    specular = np.einsum("vk,vkj->vj", share, response.specular @ fit.light)
    albedo = model.diffuse_mean[used] + np.tensordot(b, model.diffuse_basis[:, used], 1)
    total = model.sum_mean[used] + np.tensordot(b, model.sum_basis[:, used], 1)
    colors = np.asarray(observation.observed_linear)[used]
    off = colors - albedo * diffuse - total[:, None] * specular
    spread = max(1.4826 * float(np.median(np.abs(off))), 1e-6 * float(np.abs(colors).mean()))
    # Large differences count by their size rather than its square, as in the fit.
    noise = spread * np.maximum(np.abs(off), spread)
    filled = [np.zeros_like(model.diffuse_mean) for _ in range(3)] + [np.ones_like(model.diffuse_mean)]
    for whole, part in zip(filled, (diffuse, specular, off, noise), strict=True):
        whole[used] = part
    return filled[0], filled[1], filled[2], filled[3]


def _dual(
    kernel: FloatArray, lights: tuple[FloatArray, FloatArray], off: FloatArray, noise: FloatArray
) -> FloatArray:
    """Solve each vertex's 3 M equations; the arrays are (V, M, 3), the kernel (M, M)."""
    count, images, channels = off.shape
    size = images * channels
    same_channel = np.kron(kernel, np.eye(channels))
    any_channel = np.kron(kernel, np.ones((channels, channels)))
    solution = np.empty((count, size))
    for start in range(0, count, _BLOCK):
        block = slice(start, start + _BLOCK)
        diffuse, specular = (light[block].reshape(-1, size) for light in lights)
        system = same_channel * (diffuse[:, :, None] * diffuse[:, None])
        system += any_channel * (specular[:, :, None] * specular[:, None])
        system[:, np.arange(size), np.arange(size)] += noise[block].reshape(-1, size)
        solution[block] = np.linalg.solve(system, off[block].reshape(-1, size, 1))[..., 0]
    return solution.reshape(off.shape)


def _arrays(change: ModelChange) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    return change.diffuse_mean, change.diffuse_basis, change.sum_mean, change.sum_basis
