"""Whether the surface shades itself, and the mesh that does."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scan2albedo.albedo.levels import Level
from scan2albedo.albedo.options import EstimateOptions
from scan2albedo.core.geometry_image import GeometryImage, Occluder
from scan2albedo.core.plan import PlanStep
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.lighting.shadow_map import ShadowMap

FloatArray = NDArray[np.float64]

_FEWEST = 0.05
"""Part of the points that has to face a direction for its figure to mean something."""
_COARSE = 160
"""Longer side, in texels, of a chart that tells whether there are shadows."""


def shadow_caster(
    image: GeometryImage,
    level: Level,
    directions: FloatArray,
    options: EstimateOptions,
    *,
    hasty: bool = False,
) -> tuple[RayCaster | None, PlanStep]:
    """Return the shadow caster, or None where the surface hardly shades itself, and the plan's row.

    Parameters
    ----------
    image : GeometryImage
    level : Level
        Its cells are looked at.
    directions : (D, 3) float64
        Of distant lights that are tried.
    options : EstimateOptions
    hasty : bool
        Do not look whether there are shadows, and let a coarse mesh cast them.
    """
    stage, asked = "albedo.shadows", options.shadows
    if asked is False:
        return None, PlanStep(stage, False, "left out by the caller")
    coarse = _coarse_occluder(image) if asked is None else None
    vertices, faces = image.occluder_mesh() if coarse is None else coarse
    if not len(faces):
        return None, PlanStep(stage, False, "the surface has no triangle to cast a shadow", "0 faces")
    caster = RayCaster(vertices, faces)
    if hasty and asked is None:
        return caster, PlanStep(stage, True, "the budget ended before it was judged", "not judged")
    worst = _largest_shadow(
        ShadowMap(caster, level.anchor, level.normal, options.shadow_offset_mm), directions
    )
    evidence = f"at most {100 * worst:.1f} % of the texels facing a light lie in cast shadow"
    if asked is None and worst < options.shadow_fraction:
        return None, PlanStep(stage, False, "the surface casts no shadow on itself", evidence)
    if coarse is not None:
        caster = RayCaster(*image.occluder_mesh())
    return caster, PlanStep(stage, True, "asked for" if asked else "the surface shades itself", evidence)


def _coarse_occluder(image: GeometryImage) -> Occluder | None:
    """Return a mesh good enough to see whether there are shadows: a dense chart takes long to make ready.

    None where the occluder itself is at hand.
    """
    step = -(-max(image.shape) // _COARSE)
    if image.occluder is not None or step == 1:
        return None
    part = slice(None, None, step)
    mesh = GeometryImage(
        image.position[part, part], image.normal[part, part], image.mask[part, part]
    ).triangulated()
    return mesh if len(mesh[1]) else None


def _largest_shadow(shadows: ShadowMap, directions: FloatArray) -> float:
    """Return the largest part of the points facing one of `directions` (D, 3) that lies in cast shadow."""
    worst = 0.0
    for direction in directions:
        # At the terminator facets shade texels whose smooth normal still faces the light.
        facing = shadows.normal @ direction > 0.2
        if facing.mean() >= _FEWEST:
            worst = max(worst, float(np.mean(shadows.visible(direction)[facing] == 0)))
    return worst
