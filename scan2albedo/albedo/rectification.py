"""Repair of the albedo along shadow outlines, where the estimated edge misses the real one."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import binary_dilation, label, maximum_filter

from scan2albedo.albedo.poisson import forward_differences, integrate_gradients
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.core.plan import PlanStep

_BAND = 1 / 128
"""Half width of the repaired band as a part of the image's side."""
_TAIL = 0.95
"""Quantile of the gradients beside the band above which a gradient counts as steep."""
_SHARE = 0.05
"""Part of an outline's length on which the albedo has to step against the light for it to be repaired."""
_LARGEST = 1.1
"""A gradient steeper than this many times the light's step at the outline is the texture's."""
_STEP = 0.05
"""Jump of log light between neighbours that makes an outline."""


def rectify(
    albedo: FloatArray,
    light: FloatArray,
    shadow: FloatArray,
    usable: BoolArray,
    *,
    force: bool = False,
) -> tuple[FloatArray, PlanStep]:
    """Limit the gradients of log albedo in a band around shadow outlines to what is usual beside it; the row.

    Where the estimated outline misses the real one, by a penumbra or a small error of the light, the quotient
    holds a bright or dark line: the albedo steps up where the light steps down. Connected pieces of the
    outlines where it does so on more than a twentieth of their length, or all with `force`, are repaired. The
    texture's own gradients are known from beside the band: those above their 95th percentile, but no steeper
    than the light's own step makes them, are cut to it, and the albedo is integrated again from the band's
    border (gradient-domain form of the rectification of [1]_).

    `albedo` and `light` (H, W) are V of the albedo and I_a + I_d; `shadow` (H, W) is 1 where a cast shadow
    cuts any light off; `usable` (H, W) marks texels with a trustworthy albedo.

    .. [1] G. Toderici et al., "An automated method for human face modeling and relighting with
       application to face recognition", section 3.2.3.
    """
    stage, no_lines = "albedo.rectification", "shadow outlines left no lines"
    outline = shadow_outline(light, shadow, usable)
    if not outline.any():
        return albedo, PlanStep(stage, False, no_lines, "no shadow outline")
    width = max(1, round(_BAND * max(albedo.shape)))
    band = binary_dilation(outline, iterations=width) & usable
    log_albedo = np.log(np.maximum(albedo, 1e-6))
    share, wrong = _outlines_with_lines(log_albedo, light, shadow, usable, band)
    evidence = (
        f"the albedo steps against the light on {100 * share:.1f} % of the outlines, "
        f"{100 * wrong.sum() / band.sum():.0f} % of their length has lines"
    )
    if not (force or wrong.any()):
        return albedo, PlanStep(stage, False, no_lines, evidence)
    beside = binary_dilation(band, iterations=3 * width) & usable & ~band
    band = band if force else wrong
    # The largest step of log light across an outline within a square window.
    log_light, fall = np.log(np.maximum(light, 1e-6)), np.zeros(light.shape)
    for axis in (0, 1):
        step = np.abs(np.diff(log_light, axis=axis)) * outline_pairs(light, shadow, usable, axis)
        rest = [slice(None)] * 2
        for part in (slice(None, -1), slice(1, None)):
            rest[axis] = part
            fall[tuple(rest)] = np.maximum(fall[tuple(rest)], step)
    fall, cut = maximum_filter(fall, 2 * width + 1), []
    for axis, gradient in zip((1, 0), forward_differences(log_albedo), strict=True):
        outside = _pairs(beside, axis)
        if outside.sum() < 20:
            return albedo, PlanStep(stage, False, no_lines, "too few texels beside the outlines")
        limit = float(np.quantile(np.abs(gradient[outside]), _TAIL))
        ends = (fall[:, :-1], fall[:, 1:]) if axis == 1 else (fall[:-1], fall[1:])
        steep = (np.abs(gradient) > limit) & (np.abs(gradient) < _LARGEST * np.maximum(*ends))
        cut.append(np.where(steep, np.clip(gradient, -limit, limit), gradient))
    repaired = integrate_gradients(log_albedo, band, usable & ~band, *cut)
    reason = "asked for" if force else "shadow outlines left lines in the albedo"
    return np.where(band, np.exp(repaired), albedo), PlanStep(stage, True, reason, evidence)


def _outlines_with_lines(
    log_albedo: FloatArray, light: FloatArray, shadow: FloatArray, usable: BoolArray, band: BoolArray
) -> tuple[float, BoolArray]:
    """Return the share of outline pairs that show a line, less those by chance, and the pieces to repair.

    Whether the estimated shadow is too large, too small or too sharp: just at its outline the albedo steps up
    from light to shadow by about as much as the light steps down. Texture steps up as often as down. So the
    share of pairs with a step of more than half the light's, less that of pairs with such a step the other
    way, is 0 on average where the outline is right. It is taken over each connected piece of the band.
    """
    log_light = np.log(np.maximum(light, 1e-6))
    piece, count = label(band, np.ones((3, 3)))
    votes, total = np.zeros(count + 1), np.zeros(count + 1)
    for axis in (0, 1):
        here = outline_pairs(light, shadow, usable, axis)
        fall = -np.diff(log_light, axis=axis)[here]
        rise = np.diff(log_albedo, axis=axis)[here] * np.sign(fall)
        vote = (rise > np.abs(fall) / 2).astype(float) - (rise < -np.abs(fall) / 2)
        first = [slice(None)] * 2
        first[axis] = slice(None, -1)
        at = piece[tuple(first)][here]
        votes += np.bincount(at, vote, count + 1)
        total += np.bincount(at, minlength=count + 1)
    # By chance the vote of n pairs is up to about sqrt(n) off.
    guilty = votes > np.maximum(_SHARE * total, 2 * np.sqrt(np.maximum(total * _SHARE, 1)))
    guilty[0] = False
    return float(votes.sum() / max(total.sum(), 1)), guilty[piece]


def shadow_outline(light: FloatArray, shadow: FloatArray, usable: BoolArray) -> BoolArray:
    """Return (H, W) texels beside which a cast shadow ends and the light jumps by more than 5 %."""
    outline = np.zeros(light.shape, bool)
    for axis in (0, 1):
        jump = outline_pairs(light, shadow, usable, axis)
        low, high = [slice(None)] * 2, [slice(None)] * 2
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        outline[tuple(low)] |= jump
        outline[tuple(high)] |= jump
    return outline


def outline_pairs(light: FloatArray, shadow: FloatArray, usable: BoolArray, axis: int) -> BoolArray:
    """Return where a cast shadow ends, and the light jumps, from a texel to its next one along `axis`."""
    log_light = np.log(np.maximum(light, 1e-6))
    jump = (np.abs(np.diff(log_light, axis=axis)) > _STEP) & (np.diff(shadow, axis=axis) != 0)
    return jump & _pairs(usable, axis)


def _pairs(chosen: BoolArray, axis: int) -> BoolArray:
    """Return where a texel and its next one along `axis` are both chosen."""
    return chosen[:, :-1] & chosen[:, 1:] if axis == 1 else chosen[:-1] & chosen[1:]
