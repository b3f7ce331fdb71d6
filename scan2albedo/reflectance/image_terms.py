"""Colours that a morphable reflectance and a lighting model predict, and their derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scan2albedo.reflectance.environment_shading import LightResponse
from scan2albedo.reflectance.image_observation import ImageObservation
from scan2albedo.reflectance.lighting_model import LightingModel
from scan2albedo.reflectance.lobe_coefficients import Lobe
from scan2albedo.reflectance.morphable_model import MorphableReflectanceModel

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Prediction:
    """Colours (U, 3) of the vertices used, and what they were made of."""

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
    """(U, 3) what a white diffuse surface would send."""
    lobe_light: FloatArray
    """(U, 3, 3) what each lobe of weight 1 would send, by lobe and channel."""


@dataclass(frozen=True)
class ImageTerms:
    """One image's vertices U that are seen and known to the model.

    The parameters are p = (b, g, t): N coefficients of reflectance, those of light, and the logarithms of
    scale_rgb, with

        I_vj = c_v(b)_j D_v . L_j + sum_k s_v(b) w'_vk(b) S_vk . L_j,
        L_j = exp(t_j) (mean + sum g_i basis_i)_j.
    """

    used: NDArray[np.int64]
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
        """Gather what an image's terms need."""
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
