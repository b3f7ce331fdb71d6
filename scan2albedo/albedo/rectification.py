"""Repair of the albedo along shadow outlines, where the estimated edge misses the real one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from scan2albedo.albedo.poisson import forward_differences, integrate_gradients

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_BAND = 1 / 128
"""Half width of the repaired band as a part of the image's side."""
_TAIL = 0.95
"""Quantile of the gradients beside the band above which a gradient counts as steep."""
_EXCESS = 2.0
"""Steep gradients have to be this many times as frequent in the band as beside it."""
_STEP = 0.05
"""Jump of log light between neighbours that makes an outline."""


@dataclass(frozen=True)
class Rectification:
    """`albedo` (H, W), whether it was `changed`, and the figure behind the decision."""

    albedo: FloatArray
    changed: bool
    evidence: str


def rectify(
    albedo: FloatArray,
    light: FloatArray,
    shadow: FloatArray,
    usable: BoolArray,
    *,
    force: bool = False,
) -> Rectification:
    """Limit the gradients of log albedo in a band around shadow outlines to what is usual beside it.

    Where the estimated outline misses the real one, by a penumbra or a small error of the light, the
    quotient holds a bright or dark line. The texture's own gradients are known from beside the band: those
    above their 95th percentile are cut to it, and the albedo is integrated again from the band's border
    (gradient-domain form of the rectification of [1]_). Nothing is done where steep gradients are no more
    frequent in the band than beside it.

    Parameters
    ----------
    albedo, light : (H, W) float64
        V of the albedo; I_a + I_d.
    shadow : (H, W) float64
        1 where any light is cut off by a cast shadow.
    usable : (H, W) bool
        Texels with a trustworthy albedo.
    force : bool
        Repair whatever the evidence says.

    References
    ----------
    .. [1] G. Toderici et al., "An automated method for human face modeling and relighting with
       application to face recognition", section 3.2.3.
    """
    outline = shadow_outline(light, shadow, usable)
    if not outline.any():
        return Rectification(albedo, False, "no shadow outline")
    width = max(1, round(_BAND * max(albedo.shape)))
    band = binary_dilation(outline, iterations=width) & usable
    beside = binary_dilation(band, iterations=3 * width) & usable & ~band
    log_albedo = np.log(np.maximum(albedo, 1e-6))
    limits, shares, cut = [], [], []
    for axis, gradient in zip((1, 0), forward_differences(log_albedo), strict=True):
        inside, outside = _pairs(band, axis), _pairs(beside, axis)
        if outside.sum() < 20 or not inside.any():
            return Rectification(albedo, False, "too few texels beside the outlines")
        limit = float(np.quantile(np.abs(gradient[outside]), _TAIL))
        limits.append(limit)
        shares.append(float(np.mean(np.abs(gradient[inside]) > limit)))
        cut.append(np.clip(gradient, -limit, limit))
    share = float(np.mean(shares))
    evidence = (
        f"{100 * share:.1f} % steep gradients along the outlines, {100 * (1 - _TAIL):.1f} % beside them, "
        f"{100 * _EXCESS * (1 - _TAIL):.0f} % asked"
    )
    if not force and share < _EXCESS * (1 - _TAIL):
        return Rectification(albedo, False, evidence)
    repaired = integrate_gradients(log_albedo, band, usable & ~band, *cut)
    return Rectification(np.where(band, np.exp(repaired), albedo), True, evidence)


def shadow_outline(light: FloatArray, shadow: FloatArray, usable: BoolArray) -> BoolArray:
    """Return (H, W) texels beside which a cast shadow ends and the light jumps by more than 5 %."""
    outline = np.zeros(light.shape, bool)
    log_light = np.log(np.maximum(light, 1e-6))
    for axis in (0, 1):
        jump = (np.abs(np.diff(log_light, axis=axis)) > _STEP) & (np.diff(shadow, axis=axis) != 0)
        jump &= _pairs(usable, axis)
        low, high = [slice(None)] * 2, [slice(None)] * 2
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        outline[tuple(low)] |= jump
        outline[tuple(high)] |= jump
    return outline


def _pairs(chosen: BoolArray, axis: int) -> BoolArray:
    """Return where a texel and its next one along `axis` are both chosen."""
    return chosen[:, :-1] & chosen[:, 1:] if axis == 1 else chosen[:-1] & chosen[1:]
