"""What a photograph says about a face's albedo beyond a model: a smooth field of its residuals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.geometry.operators import surface_diffusion
from scan2albedo.reflectance.environment_shading import LightResponse, diffuse_response
from scan2albedo.reflectance.image_observation import ImageObservation
from scan2albedo.reflectance.morphable_model import MorphableReflectanceModel
from scan2albedo.reflectance.vertex_reflectance import VertexReflectance

_WHITE = np.sqrt(4 * np.pi)
_LEAST_OPEN = 0.4
"""A vertex that sees less of the light around it lies in a fold, where the mesh decides what is lit."""
_LEAST_LIGHT = 0.2
"""Of the median light; darker vertices tell little."""
_LEAST_DIFFUSE = 0.5
"""Of the observed light; where the highlight is more, its errors look like albedo."""
_LARGEST = 1.5
"""Of a residual: larger ones are holes, hair or other surfaces."""
_TINY = 1e-9


@dataclass(frozen=True)
class DetailOptions:
    """How residuals of a photograph are shared between albedo and errors of the light.

    Raises `ValueError` when widths do not grow, or the numbers of widths and errors differ.
    """

    widths_mm: tuple[float, ...] = (4.0, 8.0, 16.0, 32.0)
    """Standard deviations of the blurs that divide the residual into bands; what is wider than the last is
    light."""
    light_error: tuple[float, ...] = (0.05, 0.02, 0.01, 0.01)
    """Standard deviation of the logarithm of the light's error in each band: wrong normals, shadows and
    interreflection."""
    grey: float = 0.9
    """Share of that error's variance that is common to the three channels."""

    def __post_init__(self) -> None:
        widths = np.asarray(self.widths_mm)
        if not (len(widths) and widths[0] > 0 and np.isfinite(widths).all() and (np.diff(widths) > 0).all()):
            raise ValueError(f"widths_mm is {self.widths_mm}, expected positive numbers that grow")
        if len(self.light_error) != len(widths) or not all(error > 0 for error in self.light_error):
            raise ValueError(f"light_error is {self.light_error}, expected {len(widths)} positive numbers")
        if not 0 <= self.grey < 1:
            raise ValueError(f"grey is {self.grey}, expected 0 or more and below 1")


@dataclass(frozen=True)
class ShadingDivided:
    """An image divided by what a reflectance sends back under a light."""

    log_ratio: FloatArray
    """(V, 3): logarithm of the observed over the predicted diffuse light, highlights taken off; 0 where not
    seen."""
    told: BoolArray
    """(V,): where it tells about the albedo."""
    lit: BoolArray
    """(V,): where enough light arrives that predictions can be compared; contains `told`."""
    highlight_share: FloatArray
    """(V, 3): of the predicted light; 0 where not seen."""
    log_whole: FloatArray
    """(V, 3): logarithm of the observed over the whole predicted light; 0 where not seen."""

    @classmethod
    def of(
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

        told, lit = np.zeros((2, len(model.known)), bool)
        share = np.zeros((len(model.known), 3))
        bright = received.min(1) > _LEAST_LIGHT * np.median(received)
        lit[used] = bright & (open_share(observation, used, response) > _LEAST_OPEN)
        share[used] = np.clip(highlight / np.maximum(diffuse + highlight, floor), 0.0, 1.0)
        told[used] = lit[used] & (observed - highlight > _LEAST_DIFFUSE * observed).all(1)
        return cls(
            log_ratio=log_ratio(observed - highlight, diffuse),
            told=told,
            lit=lit,
            highlight_share=share,
            log_whole=log_ratio(observed, diffuse + highlight),
        )

    def left_over(self, field: FloatArray | float = 0.0) -> FloatArray:
        """Return the logarithm (V, 3) of the observed over the predicted light with details (V, 3)."""
        share = self.highlight_share
        return np.asarray(self.log_whole - np.log(share + (1 - share) * np.exp(field)))


def open_share(observation: ImageObservation, used: IntArray, response: LightResponse) -> FloatArray:
    """Return (U,) the share of the light from everywhere that nothing of the face hides."""
    free = diffuse_response(np.asarray(observation.normals)[used])[:, 0]
    return np.asarray(response.diffuse[:, 0] / np.maximum(free, _TINY))


def detail_field(
    divided: ShadingDivided,
    vertices: ArrayLike,
    faces: IntArray,
    options: DetailOptions = DetailOptions(),
) -> FloatArray:
    """Return the logarithm (V, 3) of the factor by which the albedo differs from the model's.

    Blurs of growing width divide the residual of the photograph into bands. In each, with R the residual's
    covariance (3, 3) over the channels and S that of the light's error, the best linear estimate of the
    albedo's part is (R - S) R^-1 times the residual (Wiener); R - S is cut at 0. What is wider than the last
    blur is left to the light, and nothing is said far from vertices that tell.

    Parameters
    ----------
    divided : ShadingDivided
    vertices : (V, 3) array_like of float
        Millimetres.
    faces : (F, 3) array of int
    options : DetailOptions
    """
    told = divided.told
    field = np.zeros_like(divided.log_ratio)
    if not told.any():
        return field
    finer = np.where(told[:, None], divided.log_ratio, 0.0)
    positions = np.asarray(vertices, np.float64)
    cover = told.astype(float)
    for number, (width, error) in enumerate(zip(options.widths_mm, options.light_error, strict=True)):
        blur = surface_diffusion(positions, faces, width)
        if number == 0:
            cover = blur(cover)
            coarser = blur(finer) / np.maximum(cover, 1e-6)[:, None]
            finer = np.where(told[:, None], finer, coarser)
        else:
            coarser = blur(finer)
        band = finer - coarser
        field += band @ _share_of_albedo(band[told], error, options.grey).T
        finer = coarser
    return field * np.clip(cover, 0.0, 1.0)[:, None]


def _share_of_albedo(band: FloatArray, error: float, grey: float) -> FloatArray:
    """Return (3, 3) the matrix (R - S)+ R^-1 of a band's residuals (U, 3)."""
    total = band.T @ band / len(band) + 1e-9 * np.eye(3)
    light = error**2 * (grey * np.ones((3, 3)) + (1 - grey) * np.eye(3))
    value, vector = np.linalg.eigh(total)
    root, inverse = vector * np.sqrt(value) @ vector.T, vector / np.sqrt(value) @ vector.T
    kept, axis = np.linalg.eigh(np.eye(3) - inverse @ light @ inverse)
    return np.asarray(root @ (axis * np.maximum(kept, 0.0)) @ axis.T @ inverse)


def with_details(reflectance: VertexReflectance, field: FloatArray) -> VertexReflectance:
    """Return a reflectance whose albedo is changed by factors exp(field) (V, 3)."""
    known = reflectance.known[:, None]
    diffuse = np.where(known, reflectance.diffuse_linear * np.exp(field), reflectance.diffuse_linear)
    return VertexReflectance(diffuse, reflectance.weights, reflectance.known)
