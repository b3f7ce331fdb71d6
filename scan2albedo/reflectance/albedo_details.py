"""What a photograph says about a face's albedo beyond a model: a smooth field of its residuals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.geometry.operators import surface_diffusion
from scan2albedo.reflectance.environment_shading import diffuse_response
from scan2albedo.reflectance.morphable_model import MorphableReflectanceModel
from scan2albedo.reflectance.photograph import ImageObservation
from scan2albedo.reflectance.vertex_reflectance import VertexReflectance

_BANDS = {4.0: 0.05, 8.0: 0.02, 16.0: 0.01, 32.0: 0.01}
"""Standard deviations in mm of the blurs that divide the residual into bands, and of the logarithm of the
light's error in each, from wrong normals, shadows and interreflection; what is wider than all is light."""
_GREY, _LARGEST = 0.9, 1.5
"""Share of the variance of the light's error that is common to the three channels; largest residual: larger
ones are holes, hair or other surfaces."""
_LEAST_OPEN, _LEAST_LIGHT, _LEAST_DIFFUSE = 0.4, 0.2, 0.5
"""Vertices with less of these do not count: share of the light around that a fold leaves, light over the
median, and share of the observed light that is not a highlight, whose errors look like albedo."""
_TINY = np.finfo(np.float64).eps


@dataclass(frozen=True)
class ShadingDivided:
    """An image divided by what a reflectance sends back under a light."""

    log_ratio: FloatArray
    """(V, 3): logarithm of the observed over the predicted diffuse light, highlights taken off; 0 where not
    seen."""
    usable: BoolArray
    """(V,): where it depends on the albedo."""
    lit: BoolArray
    """(V,): where enough light arrives that predictions can be compared; contains `usable`."""
    highlight_share: FloatArray
    """(V, 3): of the predicted light; 0 where not seen."""
    log_whole: FloatArray
    """(V, 3): logarithm of the observed over the whole predicted light; 0 where not seen."""

    @classmethod
    def from_observation(
        cls,
        observation: ImageObservation,
        model: MorphableReflectanceModel,
        reflectance: VertexReflectance,
        light: FloatArray,
    ) -> ShadingDivided:
        """Divide an image by a reflectance under a light (81, 3)."""
        used = np.flatnonzero(np.asarray(observation.seen) & model.known)
        response = observation.response(used)
        received = response.diffuse @ light
        highlight = np.einsum("vk,vkj->vj", reflectance.weights[used], response.specular @ light)
        diffuse = reflectance.diffuse_linear[used] * received
        observed = np.asarray(observation.observed_linear)[used]
        floor = _TINY + 1e-3 * float(np.median(diffuse))

        def log_ratio(numerator: FloatArray, denominator: FloatArray) -> FloatArray:
            whole = np.zeros((len(model.known), 3))
            ratio = np.log(np.maximum(numerator, floor) / np.maximum(denominator, floor))
            whole[used] = np.clip(ratio, -_LARGEST, _LARGEST)
            return whole

        free = diffuse_response(np.asarray(observation.normals)[used])[:, 0]
        open_share = response.diffuse[:, 0] / np.maximum(free, _TINY)
        usable, lit = np.zeros((2, len(model.known)), bool)
        share = np.zeros((len(model.known), 3))
        bright = received.min(1) > _LEAST_LIGHT * np.median(received)
        lit[used] = bright & (open_share > _LEAST_OPEN)
        share[used] = np.clip(highlight / np.maximum(diffuse + highlight, floor), 0.0, 1.0)
        usable[used] = lit[used] & (observed - highlight > _LEAST_DIFFUSE * observed).all(1)
        return cls(
            log_ratio=log_ratio(observed - highlight, diffuse),
            usable=usable,
            lit=lit,
            highlight_share=share,
            log_whole=log_ratio(observed, diffuse + highlight),
        )

    def left_over(self, field: FloatArray | float = 0.0) -> FloatArray:
        """Return the logarithm (V, 3) of the observed over the predicted light with details (V, 3)."""
        share = self.highlight_share
        return np.asarray(self.log_whole - np.log(share + (1 - share) * np.exp(field)))


def detail_field(divided: ShadingDivided, vertices: ArrayLike, faces: IntArray) -> FloatArray:
    """Return the logarithm (V, 3) of the factor by which the albedo differs from the model's.

    Blurs of growing width divide the residual of the photograph into bands. In each, with R the residual's
    covariance (3, 3) over the channels and S that of the light's error, the best linear estimate of the
    albedo's part is (R - S) R^-1 times the residual (Wiener); R - S is cut at 0. What is wider than the last
    blur is left to the light, and the field fades far from usable vertices (V, 3), mm.
    """
    usable = divided.usable
    field = np.zeros_like(divided.log_ratio)
    if not usable.any():
        return field
    positions = np.asarray(vertices, np.float64)
    finer, cover = np.where(usable[:, None], divided.log_ratio, 0.0), usable.astype(float)
    for number, (width, error) in enumerate(_BANDS.items()):
        blur = surface_diffusion(positions, faces, width)
        if number == 0:
            cover = blur(cover)
            coarser = blur(finer) / np.maximum(cover, 1e-6)[:, None]
            finer = np.where(usable[:, None], finer, coarser)
        else:
            coarser = blur(finer)
        band = finer - coarser
        inside = band[usable]
        total = inside.T @ inside / len(inside) + _TINY * np.eye(3)
        light = error**2 * (_GREY * np.ones((3, 3)) + (1 - _GREY) * np.eye(3))
        value, vector = np.linalg.eigh(total)
        root, inverse = vector * np.sqrt(value) @ vector.T, vector / np.sqrt(value) @ vector.T
        kept, axis = np.linalg.eigh(np.eye(3) - inverse @ light @ inverse)
        field += band @ (root @ (axis * np.maximum(kept, 0.0)) @ axis.T @ inverse).T
        finer = coarser
    return field * np.clip(cover, 0.0, 1.0)[:, None]
