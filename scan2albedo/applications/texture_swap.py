"""`swap_texture`: one face's shape with another's skin."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from scan2albedo.applications.processed_face import ProcessedFace, on_common_chart
from scan2albedo.applications.skin_continuation import continued, trusted


@dataclass(frozen=True)
class SwapOptions:
    """Settings of `swap_texture`."""

    match_level: bool = True
    """Scale B's albedo to A's level: an albedo's level depends on its own scan's exposure, and A's lights are
    in A's unit."""


def swap_texture(
    a: ProcessedFace, b: ProcessedFace, *, options: SwapOptions = SwapOptions()
) -> ProcessedFace:
    """Return A's geometry with B's albedo and reflectance, under A's lights.

    Where B's texture was not seen, A's detail is continued in B's colours: its gradients of log albedo are
    integrated from the border of B's seen texels, so that no seam is left [1]_. Where A's was not seen either
    the colour is continued smoothly.

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
    albedo = gain * skin.albedo_linear.astype(np.float64)
    albedo = continued(albedo, trusted(skin), shape, trusted(shape))
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


def _gain(source: ProcessedFace, target: ProcessedFace) -> float:
    level = source.level()
    return target.level() / level if level > 0 and target.level() > 0 else 1.0
