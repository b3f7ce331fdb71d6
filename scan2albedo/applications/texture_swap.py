"""`swap_texture`: one face's shape with another's skin."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scan2albedo.albedo.poisson import forward_differences, integrate_gradients
from scan2albedo.applications.compatibility import on_common_chart
from scan2albedo.applications.processed_face import ProcessedFace

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_FLOOR = 1e-5
"""Albedo below this part of the level counts as this in logarithms."""


@dataclass(frozen=True)
class SwapOptions:
    """Settings of `swap_texture`."""

    match_level: bool = True
    """Scale B's albedo to A's level. No image tells an albedo's level, each has that of its own scan's
    exposure; and A's lights are in A's unit."""
    margin: int = 2
    """Texels beside badly seen ones that are not trusted either."""


def swap_texture(
    a: ProcessedFace, b: ProcessedFace, *, options: SwapOptions = SwapOptions()
) -> ProcessedFace:
    """Return A's geometry with B's albedo and reflectance, under A's lights.

    Where B's texture was not seen, A's goes on with B's colours: its gradients in log albedo are integrated
    from the border of what was seen of B, so that no seam is left [1]_; where A's was not seen either the
    colour is continued smoothly.

    Parameters
    ----------
    a, b : ProcessedFace
        Of one model and size.
    options : SwapOptions

    Raises
    ------
    ApplicationError
        When the faces do not share a chart.

    References
    ----------
    .. [1] P. Perez, M. Gangnet, A. Blake, "Poisson image editing", SIGGRAPH 2003.
    """
    shape, skin = on_common_chart(a, b)
    gain = _gain(skin, shape) if options.match_level else 1.0
    known = trusted(skin, options.margin)
    albedo = gain * skin.albedo_linear.astype(np.float64)
    if known.any():
        albedo = continued(albedo, known, shape, trusted(shape, options.margin))
    strength = gain * skin.reflectance.specular_strength
    image = replace(
        shape.image,
        texture_linear=None,
        texture_valid=shape.mask,
        specular_scale=skin.image.specular_scale,
    )
    return replace(
        shape,
        name=f"{shape.name}+{skin.name}",
        image=image,
        albedo_linear=albedo.astype(np.float32),
        reflectance=replace(skin.reflectance, specular_strength=strength),
    )


def trusted(face: ProcessedFace, margin: int) -> BoolArray:
    """Return (H, W) texels that were seen, without those within `margin` of one that was not."""
    import cv2

    unseen = (face.mask & ~face.image.seen).astype(np.uint8)
    near = cv2.dilate(unseen, np.ones((2 * margin + 1, 2 * margin + 1), np.uint8))
    return np.asarray(face.mask & (near == 0))


def continued(albedo: FloatArray, known: BoolArray, other: ProcessedFace, guide: BoolArray) -> FloatArray:
    """Return (H, W, 3) `albedo` with the texels that are not `known` continued by the other face's gradients.

    Gradients count where both their texels lie in `guide`, and are 0 elsewhere.
    """
    floor = _FLOOR * max(other.level(), 1e-12)
    field = np.log(np.maximum(albedo, floor))
    log_other = np.log(np.maximum(other.albedo_linear.astype(np.float64), floor))
    across, down = forward_differences(log_other)
    across[~(guide[:, 1:] & guide[:, :-1])] = 0
    down[~(guide[1:] & guide[:-1])] = 0
    missing = other.mask & ~known
    filled = np.exp(integrate_gradients(field, missing, known, across, down))
    return np.where(missing[..., None], filled, albedo)


def _gain(source: ProcessedFace, target: ProcessedFace) -> float:
    level = source.level()
    return target.level() / level if level > 0 and target.level() > 0 else 1.0
