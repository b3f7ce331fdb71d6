"""After the division: shadow outlines rectified, saturated highlights resynthesised, each where it pays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_opening, binary_propagation

from scan2albedo.albedo.clipped_channels import all_channels, any_channel, restore_channels
from scan2albedo.albedo.inpainting import resynthesize
from scan2albedo.albedo.options import EstimateOptions
from scan2albedo.albedo.rectification import rectify
from scan2albedo.core.geometry_image import GeometryImage
from scan2albedo.core.plan import PlanStep

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_LARGEST_HIGHLIGHT = 0.25
"""More white texels than this part of the surface are no highlight but over-exposure."""
_ENOUGH = 64
"""Fewer trustworthy texels than this do not tell a highlight from the albedo."""
_LEAST_DEVIATION = 0.02
"""Least standard deviation of log albedo that a highlight is measured in."""


def rectified(
    albedo: FloatArray,
    light: FloatArray,
    shadow: FloatArray,
    usable: BoolArray,
    options: EstimateOptions,
    *,
    hasty: bool = False,
) -> tuple[FloatArray, PlanStep]:
    """Return V of the albedo (H, W) rectified along cast shadows, or as it is, and the plan's row.

    When `hasty`, because the budget has ended, it is left out unless asked for.
    """
    stage, asked = "albedo.rectification", options.rectification
    if left_out := _left_out(stage, asked, hasty):
        return albedo, left_out
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
    *,
    hasty: bool = False,
) -> tuple[NDArray[np.float32], PlanStep]:
    """Return the albedo (H, W, 3) with saturated texels rebuilt, or as it is, and the plan's row.

    What the input clipped decides, not what the light model expects. Where a channel survived, it tells the
    others (`restore_channels`): in highlights and under over-exposure alike. Where none did, texture is
    resynthesised from beside it (`resynthesize`), unless so much is lost that it was no highlight.
    Nothing is filled, or copied from, where the annotation forbids it. When `hasty`, because the budget has
    ended, it is left out unless asked for.
    """
    assert image.texture_linear is not None
    stage, asked = "albedo.inpainting", options.inpainting
    if left_out := _left_out(stage, asked, hasty):
        return albedo_linear, left_out
    allowed = image.mask if image.inpaint is None else image.mask & image.inpaint
    clipped = (image.texture_linear >= options.saturation_linear) & image.seen[..., None]
    # Texture lookup mixed the clipped values into their neighbours.
    lost = _with_neighbours(clipped) & (image.seen & allowed)[..., None]
    touched, wholly = any_channel(lost), all_channels(lost)
    partly = touched & ~wholly
    saturated, white = int(any_channel(clipped).sum()), int(all_channels(clipped).sum())
    evidence = (
        f"{saturated} saturated texels, {white} of them in all channels; "
        f"{int(partly.sum())} to restore from other channels, {int(wholly.sum())} to resynthesise"
    )
    if not touched.any():
        reason = "the annotation forbids it" if saturated else "nothing is saturated"
        return albedo_linear, PlanStep(stage, False, reason, evidence)
    albedo = albedo_linear.astype(np.float64)
    missed = missed_highlight(albedo, any_channel(clipped) & allowed, usable & allowed & ~touched, allowed)
    wholly |= missed
    partly &= ~missed
    source = usable & allowed & ~touched & ~missed
    result = restore_channels(albedo, lost & ~missed[..., None], source)
    if white > _LARGEST_HIGHLIGHT * image.seen.sum() and not asked:
        evidence += "; too many for a highlight, left"
    else:
        result = resynthesize(result, wholly, source, context=partly, seed=seed)
    return result.astype(np.float32), PlanStep(stage, True, "the texture is saturated", evidence)


def _left_out(stage: str, asked: bool | None, hasty: bool) -> PlanStep | None:
    """Return the plan's row of a repair that is not even looked at, else None."""
    if asked is False:
        return PlanStep(stage, False, "left out by the caller")
    if asked is None and hasty:
        return PlanStep(stage, False, "the budget ended before it")
    return None


def _with_neighbours(chosen: BoolArray) -> BoolArray:
    """Return `chosen` (H, W, C) and the four texels beside each (many times as fast as scipy's dilation)."""
    grown = chosen.copy()
    grown[1:] |= chosen[:-1]
    grown[:-1] |= chosen[1:]
    grown[:, 1:] |= chosen[:, :-1]
    grown[:, :-1] |= chosen[:, 1:]
    return grown


def missed_highlight(
    albedo_linear: FloatArray, clipped: BoolArray, source: BoolArray, allowed: BoolArray
) -> BoolArray:
    """Return (H, W) texels of highlights that the light model left in the albedo, grown from clipped texels.

    White light lifts the darkest channel most, and that channel clips last. A clipped texel in which it lies
    more than four (robust) standard deviations above the sources' median is such a highlight, with all
    connected to it that lies two above: what survived there is not the albedo's.

    Parameters
    ----------
    albedo_linear : (H, W, 3) float64
        As divided.
    clipped, source, allowed : (H, W) bool
        Texels with a clipped channel; trustworthy texels; texels that may belong to the result.
    """
    nothing = np.zeros_like(clipped)
    if int(source.sum()) < _ENOUGH:
        return nothing
    darkest = np.minimum(np.minimum(albedo_linear[..., 0], albedo_linear[..., 1]), albedo_linear[..., 2])
    level = np.log(np.maximum(darkest, 1e-4))
    middle = float(np.median(level[source]))
    deviation = max(1.4826 * float(np.median(np.abs(level[source] - middle))), _LEAST_DEVIATION)
    excess = (level - middle) / deviation
    seeds = binary_opening(clipped & (excess > 4))
    if not seeds.any():
        return nothing
    return binary_propagation(seeds, mask=allowed & (excess > 2))
