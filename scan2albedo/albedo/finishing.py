"""After the division: shadow outlines rectified, saturated highlights resynthesised, each where it pays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from scan2albedo.albedo.inpainting import resynthesize
from scan2albedo.albedo.levels import value_channel
from scan2albedo.albedo.options import EstimateOptions
from scan2albedo.albedo.rectification import rectify
from scan2albedo.io.geometry_image import GeometryImage
from scan2albedo.optimization.plan import PlanStep

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_HIGHLIGHT_SHARE = 0.1
"""Part of V above which the estimated highlight is taken to have saturated a texel."""
_LARGEST_HIGHLIGHT = 0.25
"""More such texels than this part of the surface are no highlight but over-exposure."""


def rectified(
    albedo: FloatArray, light: FloatArray, shadow: FloatArray, usable: BoolArray, options: EstimateOptions
) -> tuple[FloatArray, PlanStep]:
    """Return V of the albedo (H, W) rectified along cast shadows, or as it is, and the plan's row."""
    stage, asked = "albedo.rectification", options.rectification
    if asked is False:
        return albedo, PlanStep(stage, False, "left out by the caller")
    result = rectify(albedo, light, shadow, usable, force=asked is True)
    reason = "shadow outlines left lines in the albedo" if result.changed else "shadow outlines left no lines"
    if result.changed and asked:
        reason = "asked for"
    return result.albedo, PlanStep(stage, result.changed, reason, result.evidence)


def inpainted(
    albedo_linear: NDArray[np.float32],
    image: GeometryImage,
    specular: FloatArray,
    usable: BoolArray,
    options: EstimateOptions,
    seed: int,
) -> tuple[NDArray[np.float32], PlanStep]:
    """Return the albedo (H, W, 3) with saturated highlights resynthesised, or as it is, and the plan's row.

    A saturated texel belongs to a highlight when its colour is lost (all channels saturated), or when the
    estimated highlight `specular` (H, W) is a good part of it. Elsewhere a clipped value still bounds the
    albedo from below, and dividing it is closer to the truth than any texture from beside it.
    """
    assert image.texture_linear is not None
    stage, asked = "albedo.inpainting", options.inpainting
    if asked is False:
        return albedo_linear, PlanStep(stage, False, "left out by the caller")
    value = value_channel(image.texture_linear)
    saturated = image.seen & (value >= options.saturation_linear)
    lost = image.texture_linear.min(-1) >= options.saturation_linear
    highlight = saturated & (lost | (specular > _HIGHLIGHT_SHARE * value))
    allowed = image.mask if image.inpaint is None else image.mask & image.inpaint
    # Texture lookup mixed the clipped values into their neighbours.
    target = binary_dilation(highlight, iterations=1) & image.seen & allowed
    share = float(highlight.sum() / max(int(image.seen.sum()), 1))
    evidence = (
        f"{int(saturated.sum())} saturated texels, {int(highlight.sum())} of them in highlights, "
        f"{int(target.sum())} to fill"
    )
    if not target.any():
        reason = "the annotation forbids it" if highlight.any() else "no highlight is saturated"
        return albedo_linear, PlanStep(stage, False, reason, evidence)
    if share > _LARGEST_HIGHLIGHT and not asked:
        return albedo_linear, PlanStep(stage, False, "over-exposed, not a highlight", evidence)
    filled = resynthesize(albedo_linear.astype(np.float64), target, usable & ~target, seed=seed)
    return filled.astype(np.float32), PlanStep(stage, True, "a highlight saturated the texture", evidence)
