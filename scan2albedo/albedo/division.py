"""From light to albedo: M_A = (M_T - I_s) / (I_d + I_a), its noise drawn toward the neighbourhood."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from scan2albedo.albedo.noise import WINDOW, channel_noise, window_mean
from scan2albedo.core.arrays import BoolArray, FloatArray

_SCALES = (3, 5)
"""Sides, in texels, of the neighbourhoods toward whose means a noisy texel is drawn."""
_EDGE, _LEAST_NOISE = 3.0, 0.02
"""Standard deviations of noise, never less than this, at which a neighbour counts a quarter: it differs."""
_AROUND = 17
"""Side, in texels, of the mean that relative values refer to."""
_DARK = 1e-6
"""Least such mean, as a part of the largest."""
_DIM, _DARKER = 0.5, 0.35
"""Light, as parts of its median, below which grain is compared with that of the light, and wholly trusted."""
_GRAIN, _ROUGHER, _SMOOTH = 9 / 512, 2.0, 0.04
"""Side of the means that grain differs from, as a part of the chart's; how much rougher than in the light
texture may be; relative deviation up to which it always may."""
_BLACK = 0.05
"""Relative value up to which errors refer to that of the texel."""


@dataclass(frozen=True)
class Usual:
    """What is usual over a whole image: of noise its channel `lead` and `ratio` (`ChannelNoise`), the
    `light`, and how `rough` the albedo is where it is lit, None where nothing lies in the dark."""

    lead: int
    ratio: float
    light: float
    rough: float | None


@dataclass(frozen=True)
class Division:
    """`albedo` (H, W) or (H, W, C), 0 outside the mask, and how sure it is.

    `confidence` (H, W) in [0, 1] is how much of the texel's albedo is its own measurement, 0 where it is not
    usable; `deviation` (H, W) is the relative standard deviation of the noise that is left, 1 there.
    """

    albedo: NDArray
    confidence: FloatArray
    deviation: FloatArray
    usual: Usual
    """Of this image, for its other parts."""


def divide_light(
    texture: NDArray,
    light: FloatArray,
    specular: FloatArray,
    mask: BoolArray,
    usable: BoolArray,
    *,
    skin: NDArray | None = None,
    shrink: bool = True,
    side: int | None = None,
    usual: Usual | None = None,
) -> Division:
    """Return (M_T - I_s) / I, drawn toward the neighbourhood where noise outweighs texture.

    The quotient, relative to its mean nearby, is filtered in its leading channel and in the others'
    differences from it: noise that the channels share is in the first alone, noise of one channel in both.

    `texture` is linear, (H, W) or (H, W, C), `light` I_a + I_d > 0 (H, W) or of the texture's shape, and
    `specular` (H, W) or (H, W, 3) I_s. `mask` and `usable` (H, W) are the texels of the surface and
    those that were measured; the others keep the plain quotient, as all do without `shrink`. `skin` (H, W)
    says how surely a texel is skin, everywhere when None: what is rougher in the dark than in the light is
    noise there, but may be a beard elsewhere. `side` is that of a chart of the whole face in such texels, the
    mask's when omitted, and `usual` that of another part of the same image, so that parts join without a
    seam.
    """
    channels = texture.reshape(*mask.shape, -1).astype(np.float64)
    channels -= specular.reshape(*mask.shape, -1)
    light = np.where(light > 0, light, 1.0).reshape(*mask.shape, -1) * np.ones(channels.shape)
    quotient = np.where(mask[..., None], channels / light, 0.0)
    known = usable.astype(np.float64)
    around = np.stack([window_mean(c, known, _AROUND) for c in np.moveaxis(quotient, -1, 0)], -1)
    around = np.maximum(around, max(_DARK * float(around.max(initial=0.0)), 1e-12))
    relative = quotient / around
    lead, ratio = (None, None) if usual is None else (usual.lead, usual.ratio)
    noise = channel_noise(relative, channels, around, light, usable, lead=lead, ratio=ratio)
    weight = known * light[..., noise.lead] ** 2
    leading = _filtered(relative[..., noise.lead], weight, noise.leading)
    filtered = np.empty(relative.shape)
    for c in range(relative.shape[-1]):
        beside = relative[..., c] - relative[..., noise.lead]
        if noise.beside[..., c].any():
            beside = _filtered(beside, weight, noise.beside[..., c]).field
        filtered[..., c] = (leading.field + beside) * around[..., c]
    grain_window = max(3, 2 * round(_GRAIN * (side or max(mask.shape)) / 2 - 0.5) + 1)  # odd
    lead_light = light[..., noise.lead]
    if usual is None:
        typical = float(np.median(lead_light[usable])) if usable.any() else 1.0
        rough = _roughness(filtered[..., noise.lead], known, grain_window)
        lit, dim = usable & (lead_light > _DIM * typical), usable & (lead_light < _DIM * typical)
        limit = max(_ROUGHER * float(np.median(rough[lit])), _SMOOTH**2) if lit.any() and dim.any() else None
        usual = Usual(noise.lead, noise.ratio, typical, limit)
    # Texture is as rough in the dark as in the light, relative to its mean. What is rougher in the dark is
    # noise that the quotient amplifies, or a line along a shadow: Wiener's filter draws it toward the mean.
    grain = np.ones(mask.shape)
    dark = np.clip((_DIM - lead_light / usual.light) / (_DIM - _DARKER), 0.0, 1.0) * usable
    if usual.rough is not None and dark.any():
        rough = np.maximum(_roughness(filtered[..., noise.lead], known, grain_window), 1e-12)
        sure = dark if skin is None else dark * skin
        grain = 1 - sure * (1 - np.clip(usual.rough / rough, 0.0, 1.0))
    own = np.where(usable, leading.own * grain, 0.0)
    if (grain < 1).any():
        smooth = np.stack([window_mean(c, known, grain_window) for c in np.moveaxis(filtered, -1, 0)], -1)
        filtered = smooth + grain[..., None] * (filtered - smooth)
    kept = np.where((usable & shrink)[..., None], filtered, quotient)
    albedo = np.where(mask[..., None], np.maximum(kept, 0.0), 0.0).reshape(texture.shape)
    deviation = np.sqrt(leading.variance + own * noise.rounding) / np.maximum(leading.field, _BLACK)
    deviation = np.where(mask, np.where(usable, np.minimum(deviation, 1.0), 1.0), 0.0)
    return Division(albedo, own, deviation, usual)


def _roughness(value: FloatArray, known: FloatArray, window: int) -> FloatArray:
    """Return (H, W) the mean square difference of a field from its mean around, relative to that mean."""
    around = np.maximum(window_mean(value, known, _AROUND), 1e-12)
    relative = value / around
    return window_mean((relative - window_mean(relative, known, window)) ** 2, known, WINDOW)


@dataclass(frozen=True)
class _Filtered:
    """A field (H, W), how much of each texel is its own, and the variance of the noise that is left."""

    field: FloatArray
    own: FloatArray
    variance: FloatArray


def _filtered(field: FloatArray, weight: FloatArray, noise: FloatArray) -> _Filtered:
    """Return a field without white noise of the variance `noise` (H, W): Wiener's filter at two scales.

    The field is its mean over 5 x 5 texels, what the mean over 3 x 3 adds to it, and what the texel adds to
    that. White noise has 1/25, 1/9 - 1/25 and 1 - 1/9 of its variance in them. Of each addition, whose
    variance nearby is v and the noise's n, the best linear estimate keeps the part c = 1 - n / v; noise of
    variance c n stays. The means are weighted, and leave out what lies beyond an edge (bilateral).
    """
    field = np.ascontiguousarray(field)
    if not noise.any():
        return _Filtered(field, np.ones(field.shape), np.zeros(field.shape))
    # Running sums may end below 0 by a rounding error.
    noise_here = np.maximum(window_mean(noise, weight, WINDOW), 0.0)
    known = weight > 0
    whole = np.where(known, field, window_mean(field, known.astype(np.float64), 3))
    guide = _medians(np.pad(whole.astype(np.float32), 1, mode="edge")).astype(np.float64)
    reach = _EDGE**2 * (noise_here + _LEAST_NOISE**2)
    finer, finer_share = field, np.ones(field.shape)
    result, own, variance = np.zeros(field.shape), np.zeros(field.shape), np.zeros(field.shape)
    for window in _SCALES:
        coarser, share = _means_of_alike(field, weight, guide, reach, window)
        share = np.minimum(share, finer_share)
        added = finer - coarser
        there = np.maximum(window_mean(added**2, weight, WINDOW), 1e-30)
        part = (finer_share - share) * noise_here
        kept = np.where(part > 0, np.maximum(1 - part / there, 0.0), 1.0)
        result += kept * added
        own += kept * (finer_share - share)
        variance += kept * part
        finer, finer_share = coarser, share
    return _Filtered(result + finer, own + finer_share, variance + finer_share * noise_here)


@njit(cache=True, nogil=True)
def _medians(padded):  # type: ignore[no-untyped-def]
    """Return medians over 3 x 3: of the largest low, the median middle and the least high of columns."""
    result = np.empty((padded.shape[0] - 2, padded.shape[1] - 2), padded.dtype)
    for row in range(len(result)):
        for column in range(result.shape[1]):
            p = padded[row : row + 3, column : column + 3]
            a = _sorted_three(p[0, 0], p[1, 0], p[2, 0])
            b = _sorted_three(p[0, 1], p[1, 1], p[2, 1])
            c = _sorted_three(p[0, 2], p[1, 2], p[2, 2])
            middle = _sorted_three(a[1], b[1], c[1])[1]
            result[row, column] = _sorted_three(max(a[0], b[0], c[0]), middle, min(a[2], b[2], c[2]))[1]
    return result


@njit(cache=True, nogil=True)
def _sorted_three(a, b, c):  # type: ignore[no-untyped-def]
    low, high = min(a, b), max(a, b)
    return min(low, c), max(low, min(high, c)), max(high, c)


@njit(cache=True, nogil=True)
def _means_of_alike(field, weight, guide, reach, window):  # type: ignore[no-untyped-def]
    """Return weighted means (H, W) over windows, and the part of white noise's variance that they have.

    Texels whose guide differs by d count by 1 / (1 + d^2 / reach)^2. Texels without weight keep their value.
    """
    rows, columns = field.shape
    radius = window // 2
    mean, share = field.copy(), np.ones((rows, columns))
    for row in range(rows):
        for column in range(columns):
            if weight[row, column] <= 0:
                continue
            total = mass = squares = 0.0
            for i in range(max(0, row - radius), min(rows, row + radius + 1)):
                for j in range(max(0, column - radius), min(columns, column + radius + 1)):
                    apart = guide[i, j] - guide[row, column]
                    alike = 1 / (1 + apart * apart / reach[row, column])
                    w = weight[i, j] * alike * alike
                    total += w * field[i, j]
                    mass += w
                    squares += w * w
            mean[row, column] = total / mass
            share[row, column] = squares / (mass * mass)
    return mean, share
