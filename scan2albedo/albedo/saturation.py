"""Repair of saturated texels: lost channels from those that survived, texture where none did."""

import math

import numpy as np
from scipy.ndimage import binary_opening, binary_propagation

from scan2albedo.albedo.inpainting import RADIUS, resynthesize
from scan2albedo.albedo.node_field import FAINT
from scan2albedo.albedo.noise import window_sums
from scan2albedo.albedo.options import MINIMAL_TEXELS, SATURATION_LINEAR, EstimateOptions
from scan2albedo.albedo.texel_light import HALF_STEP
from scan2albedo.core import GeometryImage, PlanStep
from scan2albedo.core.arrays import BoolArray, Float32Array, FloatArray
from scan2albedo.geometry.fields import surroundings
from scan2albedo.statistics.robust import normal_deviation

_LARGEST_HIGHLIGHT = 0.25
"""More white texels than this part of the surface are not highlights but over-exposure."""


def inpainted(
    albedo_linear: Float32Array,
    image: GeometryImage,
    usable: BoolArray,
    options: EstimateOptions,
    seed: int,
    *,
    late: bool = False,
) -> tuple[Float32Array, PlanStep]:
    """Return the albedo (H, W, 3) with saturated texels rebuilt, or as it is, and the plan's row.

    Of the texels that the input clipped, those with a channel left follow from it (`restore_channels`); the
    others are resynthesised from beside them (`resynthesize`), unless so much is lost that it was no
    highlight. Nothing is filled, or copied from, where the annotation forbids it.
    """
    assert image.texture_linear is not None
    stage = "albedo.inpainting"
    choice = options.choice(stage)
    if choice is False:
        return albedo_linear, PlanStep(stage, False, "left out by the caller")
    if late and choice is None:
        return albedo_linear, PlanStep(stage, False, "the budget ended before it")
    allowed = image.mask if image.inpaint is None else image.mask & image.inpaint
    clipped = (image.texture_linear >= SATURATION_LINEAR) & image.seen[..., None]
    # Texture lookup mixed the clipped values into their four neighbours (scipy's dilation is far slower).
    lost = clipped.copy()
    lost[1:] |= clipped[:-1]
    lost[:-1] |= clipped[1:]
    lost[:, 1:] |= clipped[:, :-1]
    lost[:, :-1] |= clipped[:, 1:]
    lost &= (image.seen & allowed)[..., None]
    touched, wholly = any_channel(lost), all_channels(lost)
    partly = touched & ~wholly
    saturated, white = int(any_channel(clipped).sum()), int(all_channels(clipped).sum())
    evidence = (
        f"{saturated} saturated texels, {white} of them in all channels; "
        f"{partly.sum()} to restore from other channels, {wholly.sum()} to resynthesise"
    )
    if not touched.any():
        reason = "the annotation forbids it" if saturated else "nothing is saturated"
        return albedo_linear, PlanStep(stage, False, reason, evidence)
    albedo, source = albedo_linear.astype(float), usable & allowed & ~touched
    if source.sum() >= MINIMAL_TEXELS:
        missed = _missed_highlight(albedo, any_channel(clipped) & allowed, allowed, source)
        wholly, partly, source = wholly | missed, partly & ~missed, source & ~missed
        lost &= ~missed[..., None]
    result = restore_channels(albedo, lost, source)
    if white > _LARGEST_HIGHLIGHT * image.seen.sum() and not choice:
        evidence += "; too many for a highlight, left"
    else:
        result = resynthesize(result, wholly, source, context=partly, seed=seed)
    return result.astype(np.float32), PlanStep(stage, True, "the texture is saturated", evidence)


def _missed_highlight(
    albedo: FloatArray, clipped: BoolArray, allowed: BoolArray, source: BoolArray
) -> BoolArray:
    """Return (H, W) where a highlight is left that the light does not have.

    White light lifts the darkest channel most, which clips last. Clipped texels in which it lies more than
    four (robust) deviations above the sources' median are such a highlight, with all connected to them that
    lies two above: what survived there is not the albedo's.
    """
    red, green, blue = np.moveaxis(albedo, -1, 0)
    level = np.log(np.maximum(np.minimum(np.minimum(red, green), blue), FAINT))
    away = level - np.median(level[source])
    excess = away / max(normal_deviation(away[source]), HALF_STEP / math.sqrt(3))
    seeds = binary_opening(clipped & (excess > 4))
    return binary_propagation(seeds, mask=allowed & (excess > 2))


def restore_channels(albedo: FloatArray, lost: BoolArray, source: BoolArray) -> FloatArray:
    """Return `albedo` (H, W, 3) with the lost channels of texels predicted from their surviving ones.

    The camera's channels clip one after another, on skin red long before blue. Around each texel (40 texels
    at 512) the log albedo of a lost channel c is regressed on that of the surviving ones s over the sources,

    log A_c = m_c + sum_s b_s (log A_s - m_s), b = (C_ss + r)^-1 (C_sc + r / |s|),

    with means m, covariances C, in which all sources together count as 64 more, and a ridge r, the variance
    of rounding to 8 bits, that draws towards constant ratios: a guided filter [1]_. The clipped value,
    divided by the light, is the least a lost channel can be. `lost` (H, W, 3) marks channels without a
    trustworthy value; texels that lost all three, and everything when there are too few texels of `source`
    (H, W), are left as they are.

    .. [1] K. He, J. Sun, X. Tang, "Guided image filtering", ECCV 2010.
    """
    touched = any_channel(lost)
    target, origin = touched & ~all_channels(lost), source & ~touched
    if not target.any() or origin.sum() < MINIMAL_TEXELS:
        return albedo
    radius = max(4, round(RADIUS * max(target.shape)))
    window = surroundings(target, 4 * radius)
    if origin[window].sum() < MINIMAL_TEXELS:
        window = (slice(None), slice(None))
    result, inside, field = albedo.copy(), target[window], np.log(np.maximum(albedo[window], FAINT))
    # A one, the x_c and their products, summed over the sources around each texel, and over all of them.
    terms = np.concatenate([np.ones((*inside.shape, 1)), field], -1)
    products = (terms[..., None] * terms[..., None, :])[origin[window]]
    sums = np.zeros((*inside.shape, 16))
    sums[origin[window]] = products.reshape(-1, 16)
    moments = window_sums(sums, radius)[inside].reshape(-1, 4, 4) + MINIMAL_TEXELS * products.mean(0)
    moments /= moments[:, :1, :1]
    mean = moments[:, 0, 1:]
    covariance = moments[:, 1:, 1:] - mean[:, :, None] * mean[:, None]
    gone = lost[window][inside]
    kept = ~gone
    ridge = HALF_STEP**2 / 3
    system = covariance * (kept[:, :, None] & kept[:, None]) + np.eye(3) * (ridge + gone[:, None])
    right = (covariance + ridge / kept.sum(1)[:, None, None]) * kept[..., None]
    apart = (field[inside] - mean) * kept
    predicted = mean + np.einsum("tsc,ts->tc", np.linalg.solve(system, right), apart)
    old = albedo[window][inside]
    result[window][inside] = np.where(gone, np.maximum(np.exp(predicted), old), old)
    return result


def any_channel(image: BoolArray) -> BoolArray:
    """Return (H, W) where any of three channels holds (several times as fast as `image.any(-1)`)."""
    return image[..., 0] | image[..., 1] | image[..., 2]


def all_channels(image: BoolArray) -> BoolArray:
    """Return (H, W) where all three channels hold."""
    return image[..., 0] & image[..., 1] & image[..., 2]
