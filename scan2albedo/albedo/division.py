"""From light to albedo: M_A = (M_T - I_s) / (I_d + I_a), with a confidence and shrinkage in the dark."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from scan2albedo.albedo.poisson import forward_differences, integrate_gradients
from scan2albedo.core.arrays import BoolArray, FloatArray

_WINDOW = 3
"""Side, in texels, of the neighbourhood toward whose mean a noisy texel is drawn."""
_STATISTICS_WINDOW = 17
"""Side, in texels, over which variances are estimated: some 300 texels give them to a tenth."""
_NOISE_GROUPS = 12
"""Groups of equal light over which noise is separated from texture."""
_DIM = 0.15
"""Light, as a part of its median, below which it is not trusted."""
_SHARP, _BESIDE = 0.3, 9
"""Fall of log light between neighbours that makes a sharp outline; window of the means beside it."""
_TAKEN_OVER = 0.9
"""Light is continued into texels that keep less than this part of their own quotient."""


@dataclass(frozen=True)
class Division:
    """`albedo` V (H, W) and `confidence` (H, W) in [0, 1], both 0 outside the mask; `noise` of V."""

    albedo: FloatArray
    confidence: FloatArray
    noise: float


def divide_light(
    value: FloatArray,
    light: FloatArray,
    specular: FloatArray,
    mask: BoolArray,
    usable: BoolArray,
    *,
    shrink: bool = True,
) -> Division:
    """Return (V - I_s) / I, drawn toward the neighbourhood's albedo where noise outweighs it.

    With noise of standard deviation s in V the quotient has variance s^2 / I^2. Against a local variance t of
    the albedo the best linear estimate keeps the part c = t / (t + s^2 / I^2) of the texel's own deviation
    from the local mean (Wiener's filter). Where the light is less than about a seventh of its median, the
    light itself is wrong, for surfaces around send some that no lamp does: there log I is continued smoothly
    (harmonically) from where there is more, and the quotient by it takes over by the part 1 / (1 + (I / (0.15
    median I))^6). The product of the two is the confidence, 0 outside `usable`.

    `value`, `light` (> 0), `specular` (H, W) are V of the texture, I_a + I_d and I_s. Without `shrink`
    nothing is drawn toward the means, but the confidence is the same.
    """
    divisor = np.where(light > 0, light, 1.0)
    quotient = np.where(mask, np.maximum(value - specular, 0.0) / divisor, 0.0)
    weight = np.where(usable, divisor**2, 0.0)
    noise = noise_deviation(value - specular, light, usable)
    mean = _local_mean(quotient, weight, _WINDOW)
    variance = _local_mean((quotient - mean) ** 2, weight, _STATISTICS_WINDOW)
    noise_here = _local_mean(noise**2 / divisor**2, weight, _STATISTICS_WINDOW)
    # The window's own texel is part of the mean, which takes 1/n of the variance away.
    variance *= _WINDOW**2 / (_WINDOW**2 - 1)
    own = np.clip((variance - noise_here) / np.maximum(variance, 1e-30), 0.0, 1.0)
    own = np.where(noise > 0, own, 1.0)
    kept = np.where(usable, mean + own * (quotient - mean), quotient)
    typical = float(np.median(light[usable])) if usable.any() else 1.0
    # Powers of 2 and 3: NumPy multiplies for a square, but not for a sixth power.
    lit = 1 / (1 + ((_DIM * typical / divisor) ** 2) ** 3)
    if shrink:
        continued = np.maximum(value - specular, 0.0) / _continued_light(
            value, light, lit < _TAKEN_OVER, mask, usable
        )
        kept = continued + lit * (kept - continued)
    else:
        kept = quotient
    albedo = np.where(mask, np.maximum(kept, 0.0), 0.0)
    return Division(albedo, np.where(usable, own * lit, 0.0), noise)


def _continued_light(
    value: FloatArray, light: FloatArray, dim: BoolArray, mask: BoolArray, usable: BoolArray
) -> FloatArray:
    """Return `light` with its logarithm continued harmonically into `dim`; > 0 everywhere.

    Across a shadow's sharp outline the light falls by as much as `value` does on average; it is the albedo,
    and not the light, that is continuous there.
    """
    log_light = np.log(np.where(light > 0, light, 1.0))
    region, known = dim & mask, mask & ~dim
    if not (region.any() and known.any()):
        return np.exp(log_light)
    inside, outside = (_local_mean(value, (side & usable).astype(float), _BESIDE) for side in (region, known))
    around = np.log(np.maximum(np.where(region, inside, outside), 1e-6))
    falls = []
    differences = zip(forward_differences(log_light), forward_differences(around), strict=True)
    for axis, (fall, observed) in zip((1, 0), differences, strict=True):
        outline = (np.diff(region.astype(int), axis=axis) != 0) & (np.abs(fall) > _SHARP)
        falls.append(np.where(outline, observed, 0.0))
    return np.exp(integrate_gradients(log_light, region, known, *falls))


def _local_mean(field: FloatArray, weight: FloatArray, window: int) -> FloatArray:
    """Return the weighted mean over a small window; 0 where nothing in it has weight."""
    import cv2

    box, outside = (window, window), cv2.BORDER_CONSTANT
    mass = cv2.boxFilter(weight, -1, box, borderType=outside)
    total = cv2.boxFilter(field * weight, -1, box, borderType=outside)
    return np.where(mass > 1e-12, total / np.maximum(mass, 1e-12), 0.0)


def noise_deviation(diffuse: FloatArray, light: FloatArray, usable: BoolArray) -> float:
    """Return the standard deviation of additive noise in V, separated from texture by how each follows light.

    The variance of the second difference of V - I_s, `diffuse` (H, W), is k (s^2 + t I^2): noise s^2 does not
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
