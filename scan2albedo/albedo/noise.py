"""Noise apart from texture: it is white in space, not quite shared by channels, blind to the light."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.core.compiled import compiled
from scan2albedo.io.color import linear_to_srgb, srgb_to_linear

WINDOW = 25
"""Side, in texels, over which variances are estimated: some 600 texels give them to a tenth."""
_SHARED = 8.0
"""Noise that channels share is up to so many times what they do not, or what is usual in the image if that is
more: what is more in some place, such as stubble, is texture."""


@dataclass(frozen=True)
class ChannelNoise:
    """Variances of relative noise: `leading` (H, W) of channel number `lead`, and `chroma` (H, W, C).

    The latter are those of each channel's difference from the leading one. `rounding` (H, W) is what 8 bits
    alone give the leading channel.
    """

    lead: int
    leading: FloatArray
    chroma: FloatArray
    rounding: FloatArray
    ratio: float = _SHARED
    """The multiple, for the whole image, of what two channels do not share."""


def channel_noise(
    relative: FloatArray,
    texture: FloatArray,
    around: FloatArray,
    light: FloatArray,
    usable: BoolArray,
    image_noise: ChannelNoise | None = None,
) -> ChannelNoise:
    """Return how noisy the quotient of texture and light is.

    Noise is white in space, texture is not (`white_variance`). White texture, such as pores, shows in the
    channels: it moves all of them together, noise hardly ever does. So the noise of the leading channel is
    the white part of its variance, at most a multiple, the same for the whole image, of the least white part
    d_ij of a difference of two channels; and at least what it does not share with the others, half of
    d_01 + d_02 - d_12. What 8 bits do to differences is taken off. Where all channels are equal, noise that
    does not depend on the light is all that can be found (`additive_deviation`).

    `relative` (H, W, C) is the quotient divided by `around` (H, W, C), its local mean; `texture` and `light`
    (H, W, C) are the linear texture without highlights, and the light; `usable` is (H, W). `image_noise`
    is the noise of the whole image, where this is a part of it.
    """
    lead = 0 if image_noise is None else image_noise.lead
    if image_noise is None and usable.any():
        lead = int(np.argmax(around[usable].mean(0)))
    chroma = np.zeros(texture.shape)
    # What rounding of sRGB to 8 bits leaves in linear values.
    code = linear_to_srgb(np.clip(texture, 0.0, 1.0))
    rounding = (srgb_to_linear(code + 0.5 / 255) - srgb_to_linear(code - 0.5 / 255)) ** 2 / 12
    rounding /= (light * around) ** 2
    if texture.shape[-1] < 3 or not (texture[..., 1:] != texture[..., :1])[usable].any():
        deviation = additive_deviation(texture[..., lead], light[..., lead], usable)
        leading = (deviation / (light[..., lead] * around[..., lead])) ** 2
        return ChannelNoise(lead, leading, chroma, rounding[..., lead])
    pairs = (0, 1), (0, 2), (1, 2)
    steps = [relative[..., i] - relative[..., j] for i, j in pairs]
    *apart, white = np.moveaxis(white_variance(np.stack([*steps, relative[..., lead]], -1), usable), -1, 0)
    eight_bits = window_mean(rounding, usable.astype(float), WINDOW)
    differences = {}
    for (i, j), own_white in zip(pairs, apart, strict=True):
        different = np.maximum(own_white - eight_bits[..., i] - eight_bits[..., j], 0.0)
        differences[i, j] = differences[j, i] = different
    one, two = (c for c in range(3) if c != lead)
    least = np.min([differences[pair] for pair in pairs], axis=0)
    known, ratio = usable & (least > 0), _SHARED if image_noise is None else image_noise.ratio
    if image_noise is None and known.any():
        ratio = max(ratio, float(np.median(white[known] / least[known])))
    shared = np.minimum(white, ratio * least)
    own = (differences[lead, one] + differences[lead, two] - differences[one, two]) / 2
    leading = np.maximum(shared, np.minimum(own, least))
    for c in (one, two):
        # White texture may colour a channel beside the others: it leaves one difference without any.
        chroma[..., c] = np.minimum(differences[lead, c], 4 * least)
    return ChannelNoise(lead, np.maximum(leading, 0.0), chroma, rounding[..., lead], ratio)


def white_variance(fields: FloatArray, usable: BoolArray) -> FloatArray:
    """Return (H, W, C) the variance of the white part of fields, over a window about each texel; may be < 0.

    The structure function g(h) = E (f(x + h) - f(x))^2 / 2 is s^2 at every lag h for white noise, and rises
    at least in proportion to h for edges and spots of two texels and more [1]_: what is left at lag 0 of the
    line through lags 1 and 2 is noise. Stripes fall short of it at lag 3, or along one of the two axes. The
    least of all counts.

    .. [1] N. Cressie, "Statistics for spatial data", 1993, section 2.4.
    """
    if min(usable.shape) <= 3:
        return np.zeros(fields.shape)
    least = np.full(fields.shape, np.inf)
    turned = fields.swapaxes(0, 1), usable.T, least.swapaxes(0, 1)
    for values, known, found in ((fields, usable, least), turned):
        variogram = []
        for lag in (1, 2, 3):
            sums = np.zeros((*known.shape, values.shape[2] + 1))
            middle, pairs = slice(lag // 2, lag // 2 - lag), known[lag:] & known[:-lag]
            sums[middle, :, -1] = pairs
            sums[middle, :, :-1] = (values[lag:] - values[:-lag]) ** 2 / 2 * pairs[..., None]
            sums = window_sums(sums, WINDOW // 2)
            number = sums[..., -1:]
            # Fewer pairs than the window's side tell nothing.
            variogram.append(sums[..., :-1] * np.where(number >= WINDOW, 1 / np.maximum(number, 1), 0.0))
        first, second, third = variogram
        np.minimum(found, np.minimum(2 * first - second, np.minimum(second, third)), out=found)
    return least


def window_mean(field: FloatArray, weight: FloatArray, window: int) -> FloatArray:
    """Return the weighted means of (H, W) or (H, W, C) over a square window; 0 where nothing has weight."""
    each = field.reshape(*weight.shape, -1)
    sums = window_sums(np.dstack([weight[..., None] * each, weight]), window // 2)
    mass = sums[..., -1:]
    return np.where(mass > 1e-9, sums[..., :-1] / np.maximum(mass, 1e-9), 0.0).reshape(field.shape)


@compiled
def window_sums(values, radius):  # type: ignore[no-untyped-def]
    """Return the sums of `values` (H, W, C) over windows: what enters is added, what leaves is taken off."""
    rows, columns, channels = values.shape
    sums, total, result = np.zeros((columns, channels)), np.empty(channels), np.empty(values.shape)
    for i in range(-radius, rows):
        if i + radius < rows:
            sums += values[i + radius]
        if i > radius:
            sums -= values[i - radius - 1]
        total[:] = 0.0
        for j in range(-radius, columns if i >= 0 else -radius):
            for c in range(channels):
                if j + radius < columns:
                    total[c] += sums[j + radius, c]
                if j > radius:
                    total[c] -= sums[j - radius - 1, c]
                if j >= 0:
                    result[i, j, c] = total[c]
    return result


def additive_deviation(diffuse: FloatArray, light: FloatArray, usable: BoolArray) -> float:
    """Return the standard deviation of additive noise, separated from texture by how each follows light.

    The variance of the second difference of T - I_s, `diffuse` (H, W), is k (s^2 + t I^2): noise s^2 does not
    depend on the light I, texture t is multiplied by it. Both are fitted, not negative, to the medians over
    groups of texels of equal I. 0 where the light hardly varies, since the two cannot be separated there.
    """
    second = diffuse[:, 1:-1] - (diffuse[:, :-2] + diffuse[:, 2:]) / 2
    inner = usable[:, 1:-1] & usable[:, :-2] & usable[:, 2:]
    # A shadow's edge is neither noise nor texture.
    chosen = inner & (np.abs(light[:, 2:] - light[:, :-2]) < 0.1 * light[:, 1:-1])
    count = int(chosen.sum()) // WINDOW**2
    if count < 2:
        return 0.0
    square, energy = second[chosen] ** 2 / 1.5, light[:, 1:-1][chosen] ** 2
    groups = np.array_split(np.argsort(energy, kind="stable"), count)
    # The median of a squared normal deviate is 0.4549 of its variance.
    variance = np.array([np.median(square[group]) for group in groups]) / 0.4549
    level = np.array([np.mean(energy[group]) for group in groups])
    if level.max() < 2 * level.min() or variance.max() <= 0:
        return 0.0
    weight = 1 / np.maximum(variance, 1e-6 * variance.max())
    (noise, _), _ = nnls(np.stack([weight, weight * level], 1), weight * variance)
    return float(np.sqrt(noise))
