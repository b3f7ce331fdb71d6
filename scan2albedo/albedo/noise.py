"""Noise apart from texture: it is white in space, not quite shared by channels, blind to the light."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.optimize import nnls

from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.io.color import linear_to_srgb, srgb_to_linear

WINDOW = 25
"""Side, in texels, over which variances are estimated: some 600 texels give them to a tenth."""
_LEAST_PAIRS = 40
"""Pairs of texels without which a window tells nothing."""
_WHITE_TEXTURE = 0.016
"""Standard deviation, as a part of the albedo, of texture that is as white as noise: pores of one texel."""
_RATIO, _ABOVE = (2.0, 16.0), 2.0
"""Bounds of the leading channel's noise as a multiple of what two channels do not share, and how far above
its median over the image that multiple goes: where more is white it is stubble, not noise."""
_OWN = 0.6
"""Most that one channel has of the variance of the difference of two."""
_UNDERRATED = 1.2
"""Noise over its estimate: the least of six falls short, and a line through lags does on smooth texture."""
_HEAVY = 2.0
"""Most that the mean square of noise exceeds its robust estimate: heavy tails, not lines of the texture."""
_GREY = 1e-3
"""Channels that differ by less than this, white = 1, are one."""
_NOISE_GROUPS = 12
"""Groups of equal light over which noise is separated from texture."""


@dataclass(frozen=True)
class ChannelNoise:
    """Variances of relative noise: `leading` (H, W) of channel number `lead`, and `beside` (H, W, C).

    The latter are those of each channel's difference from the leading one. `rounding` (H, W) is what 8 bits
    alone give the leading channel.
    """

    lead: int
    leading: FloatArray
    beside: FloatArray
    rounding: FloatArray
    ratio: float = 1.0
    """The multiple, for the whole image, of what two channels do not share."""


def channel_noise(
    relative: FloatArray,
    texture: FloatArray,
    around: FloatArray,
    light: FloatArray,
    usable: BoolArray,
    *,
    lead: int | None = None,
    ratio: float | None = None,
) -> ChannelNoise:
    """Return how noisy the quotient of texture and light is.

    Noise is white in space, texture is not (`white_variance`). White texture, such as pores, shows in the
    channels: it moves all of them together, noise hardly ever does. So the noise of the leading channel is
    the white part of its variance, less what texture may have of it, at most a multiple, the same for the
    whole image, of the least white part d_ij of a difference of two channels; and at least what it does not
    share with the others, which is half of d_01 + d_02 - d_12. What 8 bits do to differences is taken off.
    Where all channels are equal, noise that does not depend on the light is all that can be found
    (`additive_deviation`).

    `relative` (H, W, C) is the quotient divided by `around` (H, W, C), its local mean; `texture` and `light`
    (H, W, C) are the linear texture without highlights, and the light; `usable` is (H, W). `lead` and `ratio`
    are those of the whole image, where this is a part of it.
    """
    if lead is None:
        lead = int(np.argmax(around[usable].mean(0))) if usable.any() else 0
    beside = np.zeros(texture.shape)
    # What rounding of sRGB to 8 bits leaves in linear values.
    code = linear_to_srgb(np.clip(texture, 0.0, 1.0))
    rounding = (srgb_to_linear(code + 0.5 / 255) - srgb_to_linear(code - 0.5 / 255)) ** 2 / 12
    rounding /= (light * around) ** 2
    spread = np.ptp(texture[usable], axis=-1) if usable.any() else np.zeros(1)
    if texture.shape[-1] < 3 or spread.max(initial=0.0) < _GREY:
        deviation = additive_deviation(texture[..., lead], light[..., lead], usable)
        leading = (deviation / (light[..., lead] * around[..., lead])) ** 2
        return ChannelNoise(lead, leading, beside, rounding[..., lead])
    differences = {}
    for i, j in ((0, 1), (0, 2), (1, 2)):
        eight_bits = window_mean(rounding[..., i] + rounding[..., j], usable.astype(float), WINDOW)
        white = white_variance(relative[..., i] - relative[..., j], usable)
        differences[i, j] = differences[j, i] = np.maximum(white - eight_bits, 0.0)
    one, two = (c for c in range(3) if c != lead)
    least = np.minimum(np.minimum(differences[lead, one], differences[lead, two]), differences[one, two])
    white = white_variance(relative[..., lead], usable)
    if ratio is None:
        known = usable & (least > 0)
        usual = float(np.median(white[known] / least[known])) if known.any() else 0.0
        ratio = float(np.clip(_ABOVE * usual, *_RATIO))
    shared = np.minimum(white - _WHITE_TEXTURE**2, ratio * least)
    own = (differences[lead, one] + differences[lead, two] - differences[one, two]) / 2
    leading = np.maximum(_UNDERRATED * shared, np.minimum(own, _OWN * least))
    for c in (one, two):
        # White texture may colour a channel beside the others: it leaves one difference without any.
        beside[..., c] = np.minimum(differences[lead, c], 4 * least)
    return ChannelNoise(lead, np.maximum(leading, 0.0), beside, rounding[..., lead], ratio)


def white_variance(field: FloatArray, usable: BoolArray) -> FloatArray:
    """Return (H, W) the variance of the white part of a field, over a window about each texel; may be < 0.

    The structure function g(h) = E (f(x + h) - f(x))^2 / 2 is s^2 at every lag h for white noise, and rises
    at least in proportion to h for edges and spots of two texels and more: what is left at lag 0 of the line
    through lags 1 and 2 is noise. Stripes fall short of it at lag 3, or along one of the two axes; lone lines
    and points do where g is estimated robustly [1]_. The least of all counts.

    .. [1] N. Cressie, D. Hawkins, "Robust estimation of the variogram", Mathematical Geology 12, 1980.
    """
    least, field = np.full(field.shape, np.inf), np.ascontiguousarray(field)
    if min(field.shape) <= 3:
        return np.zeros(field.shape)
    for axis in (0, 1):
        # g along the axis over a window, by mean squares and robustly; 0 from too few texels.
        lags = []
        for lag in (1, 2, 3):
            down, across = (lag, 0) if axis == 0 else (0, lag)
            pairs, squares, roots = (_sum(part, WINDOW) for part in _steps(field, usable, down, across))
            share = np.where(pairs >= _LEAST_PAIRS, 1 / np.maximum(pairs, 1.0), 0.0)
            # The mean of the root of a normal deviate's size, to the fourth power, is 0.457 of its variance.
            robust = (share * np.maximum(roots, 0.0)) ** 2
            lags.append((share * squares, robust * robust / 0.457))
        for (first, second, third), slack in zip(zip(*lags, strict=True), (1.0, _HEAVY), strict=True):
            white = np.minimum(2 * first - second, np.minimum(second, third))
            least = np.minimum(least, slack * white)
    return least


@njit(cache=True, nogil=True)
def _steps(field, usable, down, across):  # type: ignore[no-untyped-def]
    """Return (H, W) of the pairs of texels so far apart, in their middles: whether both are usable, half the
    square of their difference, and the fourth root of that."""
    rows, columns = field.shape
    pairs, squares, roots = np.zeros((3, rows, columns))
    for row in range(rows - down):
        for column in range(columns - across):
            if usable[row, column] and usable[row + down, column + across]:
                half = 0.5 * (field[row + down, column + across] - field[row, column]) ** 2
                i, j = row + down // 2, column + across // 2
                pairs[i, j] = 1.0
                squares[i, j] = half
                roots[i, j] = np.sqrt(np.sqrt(half))
    return pairs, squares, roots


@njit(cache=True, nogil=True)
def _sum(field, window):  # type: ignore[no-untyped-def]
    """Return (H, W) running sums over square windows of odd sides; 0 counts outside the image."""
    rows, columns = field.shape
    radius, result, down = window // 2, np.empty((rows, columns)), np.zeros(columns)
    for row in range(-radius, rows):
        if row + radius < rows:
            for column in range(columns):
                down[column] += field[row + radius, column]
        if row > radius:
            for column in range(columns):
                down[column] -= field[row - radius - 1, column]
        if row < 0:
            continue
        total = down[:radius].sum()
        for column in range(columns):
            if column + radius < columns:
                total += down[column + radius]
            if column > radius:
                total -= down[column - radius - 1]
            result[row, column] = total
    return result


def window_mean(field: FloatArray, weight: FloatArray, window: int) -> FloatArray:
    """Return the weighted mean over a square window; 0 where nothing in it has weight."""
    mass = _sum(weight, window)
    return np.where(mass > 1e-12, _sum(field * weight, window) / np.maximum(mass, 1e-12), 0.0)


def additive_deviation(diffuse: FloatArray, light: FloatArray, usable: BoolArray) -> float:
    """Return the standard deviation of additive noise, separated from texture by how each follows light.

    The variance of the second difference of T - I_s, `diffuse` (H, W), is k (s^2 + t I^2): noise s^2 does not
    depend on the light I, texture t is multiplied by it. Both are fitted, not negative, to the medians over
    texels grouped by I. 0 where the light hardly varies, since the two cannot be separated there.
    """
    second = diffuse[:, 1:-1] - 0.5 * (diffuse[:, :-2] + diffuse[:, 2:])
    inner = usable[:, 1:-1] & usable[:, :-2] & usable[:, 2:]
    # A shadow's edge is neither noise nor texture.
    jump = np.abs(light[:, 2:] - light[:, :-2]) < 0.1 * light[:, 1:-1]
    chosen = inner & jump
    if int(chosen.sum()) < 100 * _NOISE_GROUPS:
        return 0.0
    square, energy = second[chosen] ** 2 / 1.5, light[:, 1:-1][chosen] ** 2
    groups = np.array_split(np.argsort(energy, kind="stable"), _NOISE_GROUPS)
    # The median of a squared normal deviate is 0.4549 of its variance.
    variance = np.array([np.median(square[group]) for group in groups]) / 0.4549
    level = np.array([np.mean(energy[group]) for group in groups])
    if level.max() < 2 * level.min() or variance.max() <= 0:
        return 0.0
    weight = 1 / np.maximum(variance, 1e-6 * variance.max())
    (noise, _), _ = nnls(np.stack([weight, weight * level], 1), weight * variance)
    return float(np.sqrt(noise))
