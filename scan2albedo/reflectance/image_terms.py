"""The terms of an image fit: predicted colours with derivatives, and a measure of the caller's."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.errors import ReflectanceError
from scan2albedo.reflectance.environment_shading import LightResponse
from scan2albedo.reflectance.image_observation import ImageObservation
from scan2albedo.reflectance.lighting_model import LightingModel
from scan2albedo.reflectance.lobe_coefficients import Lobe
from scan2albedo.reflectance.morphable_model import MorphableReflectanceModel

PerceptualDistance = Callable[[FloatArray, FloatArray], tuple[float, ArrayLike]]
"""From predicted and observed linear colours (V, 3), NaN at vertices that are not used, to a value and its
gradient (V, 3) by the predicted ones; gradients at vertices that are not used are ignored."""

_PRIOR_WEIGHT = {True: 3e-4, False: 1e-3}


@dataclass(frozen=True)
class ImageFitOptions:
    """Settings of `fit_image`."""

    photometric_weight: float = 2.0
    """Of the mean absolute difference, in units of the image's median colour."""
    prior_weight: float | None = None
    """Of the squared coefficients of reflectance and light. None takes 3e-4 where the observation has a
    transfer and 1e-3 where it has none: shadow that is not modelled must not pass for skin."""
    softness: float = 0.01
    """Differences below this share of the median colour count by their squares (Charbonnier's epsilon)."""
    perceptual_weight: float = 0.1
    """Of the value that `perceptual` returns; see `fit_image`."""
    lobe: Lobe = "tilted"
    """Lobe of the highlights where the observation has no transfer; see `shade_environment`."""

    def __post_init__(self) -> None:
        for name in ("photometric_weight", "softness"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be above 0, got {getattr(self, name)}")
        if not self.perceptual_weight >= 0:
            raise ValueError(f"perceptual_weight must be 0 or more, got {self.perceptual_weight}")
        if self.prior_weight is not None and not self.prior_weight >= 0:
            raise ValueError(f"prior_weight must be 0 or more, or None, got {self.prior_weight}")

    def prior_weight_of(self, *, shadows_modelled: bool) -> float:
        """Return `prior_weight`, or the default for None."""
        return _PRIOR_WEIGHT[shadows_modelled] if self.prior_weight is None else self.prior_weight


@dataclass(frozen=True)
class Prediction:
    """Colours (U, 3) of the vertices used, and their parts."""

    color: FloatArray
    diffuse: FloatArray
    """(U, 3) c."""
    total: FloatArray
    """(U,) s."""
    share: FloatArray
    """(U, 3) w'."""
    light: FloatArray
    """(81, 3)."""
    diffuse_light: FloatArray
    """(U, 3) radiance of a white diffuse surface."""
    lobe_light: FloatArray
    """(U, 3, 3) radiance of each lobe of weight 1, by lobe and channel."""


@dataclass(frozen=True)
class ImageTerms:
    """One image's vertices U that are seen and known to the model.

    The parameters are p = (b, g, t): N coefficients of reflectance, those of light, and the logarithms of
    scale_rgb, with

        I_vj = c_v(b)_j D_v . L_j + sum_k s_v(b) w'_vk(b) S_vk . L_j,
        L_j = exp(t_j) (mean + sum g_i basis_i)_j.
    """

    used: IntArray
    observed: FloatArray
    response: LightResponse
    mean: tuple[FloatArray, FloatArray, FloatArray]
    """Of c, s and w' at the vertices used."""
    basis: tuple[FloatArray, FloatArray, FloatArray]
    """The same, directions last: (U, 3, N), (U, N), (U, 3, N)."""
    lighting: LightingModel

    @classmethod
    def of(
        cls,
        observation: ImageObservation,
        model: MorphableReflectanceModel,
        lighting: LightingModel,
        lobe: Lobe,
    ) -> ImageTerms:
        """Gather the inputs of an image's terms."""
        used = np.flatnonzero(np.asarray(observation.seen) & model.known)
        last = [
            np.ascontiguousarray(np.moveaxis(basis[:, used], 0, -1))
            for basis in (model.diffuse_basis, model.sum_basis, model.share_basis)
        ]
        return cls(
            used,
            np.asarray(observation.observed_linear)[used],
            observation.response(used, lobe),
            (model.diffuse_mean[used], model.sum_mean[used], model.share_mean[used]),
            (last[0], last[1], last[2]),
            lighting,
        )

    def split(self, parameters: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return b, g and t of parameters."""
        first = self.basis[1].shape[1]
        return parameters[:first], parameters[first:-3], parameters[-3:]

    def predict(self, parameters: FloatArray) -> Prediction:
        """Return the colours of parameters."""
        b, g, t = self.split(parameters)
        diffuse, total, share = (mean + basis @ b for mean, basis in zip(self.mean, self.basis, strict=True))
        light = self.lighting.light(g, scale_rgb=np.exp(t))
        diffuse_light = self.response.diffuse @ light
        lobe_light = self.response.specular @ light
        color = diffuse * diffuse_light + total[:, None] * np.einsum("vk,vkj->vj", share, lobe_light)
        return Prediction(color, diffuse, total, share, light, diffuse_light, lobe_light)

    def jacobian(self, parameters: FloatArray, at: Prediction) -> FloatArray:
        """Return the derivatives (U, 3, P) of the colours by the parameters."""
        _, _, t = self.split(parameters)
        by_diffuse, by_total, by_share = self.basis
        weights = by_total[:, None] * at.share[..., None] + at.total[:, None, None] * by_share
        by_b = by_diffuse * at.diffuse_light[..., None] + np.swapaxes(at.lobe_light, 1, 2) @ weights
        specular = np.einsum("vk,vkh->vh", at.total[:, None] * at.share, self.response.specular)
        by_g = np.empty((*at.color.shape, self.lighting.components))
        by_t = np.zeros((*at.color.shape, 3))
        for channel in range(3):
            reflected = at.diffuse[:, channel, None] * self.response.diffuse + specular
            by_g[:, channel] = reflected @ (np.exp(t[channel]) * self.lighting.basis[:, :, channel].T)
            by_t[:, channel, channel] = at.color[:, channel]
        return np.concatenate([by_b, by_g, by_t], axis=2)


@dataclass(frozen=True)
class PerceptualValue:
    """The distance at one prediction."""

    value: float
    gradient: FloatArray
    """(U, 3) by the colours used."""

    @property
    def first_curvature(self) -> float:
        """Second derivative of a multiple of the squared distance whose least value is 0."""
        return float(np.sum(self.gradient**2)) / (2 * abs(self.value)) if self.value else 0.0


class PerceptualTerm:
    """The caller's function over the vertices `used` (U,) of `count`; checks what it returns."""

    def __init__(
        self, distance: PerceptualDistance, used: IntArray, observed_linear: FloatArray, count: int
    ) -> None:
        self._distance, self._used, self._count = distance, used, count
        self._observed = self._spread(observed_linear)

    def at(self, color: FloatArray) -> PerceptualValue:
        """Return value and gradient at predicted colours (U, 3)."""
        # Copies, so that a function that writes into its arguments harms nobody.
        answer = self._distance(self._spread(color), self._observed.copy())
        try:
            value, gradient = float(answer[0]), np.asarray(answer[1], np.float64)
        except (TypeError, ValueError, IndexError) as error:
            raise ReflectanceError(
                f"the perceptual function returned {type(answer).__name__}, expected a number and its "
                f"gradient ({self._count}, 3) by the predicted colours"
            ) from error
        if gradient.shape != (self._count, 3):
            raise ReflectanceError(
                f"the perceptual function returned a gradient {gradient.shape}, expected ({self._count}, 3), "
                "one row for each vertex"
            )
        bad = ~np.isfinite(gradient[self._used]).all(1)
        if not np.isfinite(value) or bad.any():
            what = f"the value {value}" if not np.isfinite(value) else f"no gradient at {bad.sum()} vertices"
            raise ReflectanceError(
                f"the perceptual function returned {what}; it must leave out vertices that are NaN in the "
                "predicted colours"
            )
        return PerceptualValue(value, gradient[self._used])

    def _spread(self, color: FloatArray) -> FloatArray:
        result = np.full((self._count, 3), np.nan)
        result[self._used] = color
        return result


def secant_curvature(before: PerceptualValue, after: PerceptualValue, step: FloatArray) -> float:
    """Return the second derivative along a step (U, 3) of the colours, 0 where it is negative."""
    length = float(np.sum(step**2))
    bend = float(np.sum((after.gradient - before.gradient) * step))
    return max(bend / length, 0.0) if length > 0 else 0.0
