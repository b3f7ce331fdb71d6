"""From light to albedo: M_A = (M_T - I_s) / (I_d + I_a), its noise drawn toward the neighbourhood."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter

from scan2albedo.albedo.noise import WINDOW, ChannelNoise, channel_noise, window_mean
from scan2albedo.core.arrays import BoolArray, FloatArray, NDArray
from scan2albedo.core.compiled import compiled

_SCALES = (3, 5)
"""Sides, in texels, of the neighbourhoods toward whose means a noisy texel is drawn."""


@dataclass(frozen=True)
class Division:
    """`albedo` (H, W) or (H, W, C), 0 outside the mask, and how sure it is.

    `confidence` (H, W) in [0, 1] is how much of the texel's albedo is its own measurement, 0 where it is not
    usable; `deviation` (H, W) is the relative standard deviation of the noise that is left, 1 there.
    """

    albedo: NDArray
    confidence: FloatArray
    deviation: FloatArray
    noise: ChannelNoise
    """Of this image: what is usual in it serves its other parts."""


def divide_light(
    texture: NDArray,
    light: FloatArray,
    specular: FloatArray,
    mask: BoolArray,
    usable: BoolArray,
    *,
    image_noise: ChannelNoise | None = None,
) -> Division:
    """Return (M_T - I_s) / I, drawn toward the neighbourhood where noise outweighs texture.

    The quotient, relative to its mean nearby, is filtered in its leading channel and in the others'
    differences from it: noise that the channels share is in the first alone, noise of one channel in both.

    `texture` is linear, (H, W) or (H, W, C), `light` I_a + I_d > 0 (H, W) or of the texture's shape, and
    `specular` (H, W) or (H, W, 3) I_s. `mask` and `usable` (H, W) are the texels of the surface and
    those that were measured; the others keep the plain quotient. `image_noise` is the noise of another part
    of the same image, so that parts join without a seam.
    """
    channels = texture.reshape(*mask.shape, -1).astype(float)
    channels -= specular.reshape(*mask.shape, -1)
    light = np.where(light > 0, light, 1.0).reshape(*mask.shape, -1) * np.ones(channels.shape)
    quotient = np.where(mask[..., None], channels / light, 0.0)
    known = usable.astype(float)
    around = window_mean(quotient, known, WINDOW)
    around = np.maximum(around, max(1e-6 * float(around.max(initial=0.0)), 1e-12))
    relative = quotient / around
    noise = channel_noise(relative, channels, around, light, usable, image_noise)
    weight = known * light[..., noise.lead] ** 2
    leading, own, left = _filtered(relative[..., noise.lead], weight, noise.leading)
    filtered = np.empty(relative.shape)
    for c in range(relative.shape[-1]):
        chroma = relative[..., c] - relative[..., noise.lead]
        if noise.chroma[..., c].any():
            chroma = _filtered(chroma, weight, noise.chroma[..., c])[0]
        filtered[..., c] = (leading + chroma) * around[..., c]
    own[~usable] = 0.0
    kept = np.where(usable[..., None], filtered, quotient)
    albedo = np.where(mask[..., None], np.maximum(kept, 0.0), 0.0).reshape(texture.shape)
    deviation = np.sqrt(left + own * noise.rounding) / np.maximum(leading, 1e-12)
    deviation = np.where(mask, np.where(usable, np.minimum(deviation, 1.0), 1.0), 0.0)
    return Division(albedo, own, deviation, noise)


def _filtered(field: FloatArray, weight: FloatArray, noise: FloatArray) -> FloatArray:
    """Return a field without white noise of the variance `noise` (H, W): Wiener's filter at two scales.

    The result is (3, H, W): the field, how much of each texel is its own, the variance of what noise is left.
    The field is its mean over 5 x 5 texels, what the mean over 3 x 3 adds to it, and what the texel adds to
    that. White noise has 1/25, 1/9 - 1/25 and 1 - 1/9 of its variance in them. Of each addition, whose
    variance nearby is v and the noise's n, the best linear estimate keeps the part c = 1 - n / v; noise of
    variance c n stays. The means are weighted, and leave out what lies beyond an edge (bilateral).
    """
    field = np.ascontiguousarray(field)
    if not noise.any():
        return np.stack([field, np.ones(field.shape), np.zeros(field.shape)])
    # Running sums may end below 0 by a rounding error.
    noise_here = np.maximum(window_mean(noise, weight, WINDOW), 0.0)
    known = weight > 0
    whole = np.where(known, field, window_mean(field, known.astype(float), 3))
    guide = median_filter(whole, 3, mode="nearest")
    # A neighbour that differs by three standard deviations of noise counts a quarter.
    reach = np.maximum(3.0**2 * noise_here, 1e-12)
    finer, finer_share = field, np.ones(field.shape)
    result, own, variance = np.zeros(field.shape), np.zeros(field.shape), np.zeros(field.shape)
    for window in _SCALES:
        coarser, share = _bilateral_means(field, weight, guide, reach, window)
        share = np.minimum(share, finer_share)
        added = finer - coarser
        there = np.maximum(window_mean(added**2, weight, WINDOW), 1e-30)
        part = (finer_share - share) * noise_here
        kept = np.where(part > 0, np.maximum(1 - part / there, 0.0), 1.0)
        result += kept * added
        own += kept * (finer_share - share)
        variance += kept * part
        finer, finer_share = coarser, share
    return np.stack([result + finer, own + finer_share, variance + finer_share * noise_here])


@compiled(error_model="numpy")
def _bilateral_means(field, weight, guide, reach, window):  # type: ignore[no-untyped-def]
    """Return weighted means (H, W) over windows, and the part of white noise's variance that they have.

    Texels whose guide differs by d count by 1 / (1 + d^2 / reach)^2. Texels without weight keep their value.
    """
    rows, columns = field.shape
    radius = window // 2
    mean, share = field.copy(), np.ones((rows, columns))
    total, mass, squares = np.empty((3, columns))
    for row in range(rows):
        total[:] = 0.0
        mass[:] = 0.0
        squares[:] = 0.0
        # Along a row neighbours lie side by side, so that several are compared at once.
        for i in range(max(0, row - radius), min(rows, row + radius + 1)):
            for step in range(-radius, radius + 1):
                here, there = max(0, -step), max(0, step)
                width = columns - here - there
                own, near, far = guide[row, here:], guide[i, there:], reach[row, here:]
                value, known = field[i, there:], weight[i, there:]
                sums, masses, products = total[here:], mass[here:], squares[here:]
                for column in range(width):
                    apart = near[column] - own[column]
                    similarity = far[column] / (far[column] + apart * apart)
                    w = known[column] * similarity * similarity
                    sums[column] += w * value[column]
                    masses[column] += w
                    products[column] += w * w
        for column in range(columns):
            if weight[row, column] > 0:
                mean[row, column] = total[column] / mass[column]
                share[row, column] = squares[column] / (mass[column] * mass[column])
    return mean, share
