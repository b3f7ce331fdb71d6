"""How far the colour and the grain of a texture are from those of the face's own skin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter, uniform_filter

from scan2albedo.core.arrays import BoolArray, FloatArray

Image = NDArray[np.float32]

TYPICAL_CHROMA, TYPICAL_SPREAD = np.array([0.5, -0.35]), np.array([0.35, 0.4])
"""log R/G and log B/G (linear) of skin, pale to dark, under lamps, skies, in rooms; standard deviations."""
_SAME_MATERIAL = 0.12
"""Chroma [log] within which texels are one material under one light."""
_REACH = 1.5
"""Standard deviations within which texels join the skin: others may be cloth over half the face."""
_LIGHT_COLOR = np.array([0.3] * 3 + [0.15] * 4 + [0.1])
"""Standard deviations of how the light's colour turns with the normal and with the brightness [log]."""
_FINEST, _COARSEST = np.array([0.06, 0.08]), np.array([0.12, 0.16])
"""Least spread of a face's own chroma, through blush and freckles, and most [log]."""
_QUANTIZATION = 6e-4
"""Linear error of 8-bit sRGB in the darks, which blurs the chroma there."""
_DARKEST = 1e-3
"""Parts of white below which there is no colour to compare."""
_SAMPLES, _INDEPENDENT, _CANDIDATES, _ROUNDS = 4000, 50, 32, 6
_BESIDE_ANCHORS = 0.3
"""Weight of texels outside the anchors, which say how the light's colour goes on there."""
_SKIN_GRAIN, _LEAST_GRAIN, _MOST_GRAIN = 1.8, 0.025, 0.12
"""Contrast beyond so many times the median of the face's own skin is not skin's; least and most [log]."""
_SHADOW_GRAIN = 0.09
"""Parts of white at which a picture's noise has grown by a half."""
_GRAIN_MM, _AROUND_MM = 10.5, 21.0
"""Sides of the squares over which grain is counted, and which is around."""
_FINE_MM = 1.8
"""Size of texels up to which skin's own relief makes no contrast; it grows with the square of the size."""


@dataclass(frozen=True)
class ColorEvidence:
    """What speaks against skin, (H, W) each; 0 where the texture is not known."""

    chroma: Image
    """Distance from the face's skin in standard deviations, the light's colour allowed for."""
    grain: Image
    """Part of the texels around whose fine contrast is stronger than that of the face's skin."""
    darkness: Image
    """Natural logarithm of how much brighter the texels around are, at least 0."""


def color_evidence(
    texture_linear: Image, normal: Image, known: BoolArray, anchor: BoolArray, texel_mm: float
) -> ColorEvidence:
    """Compare each `known` texel (H, W) of `texel_mm`, at best some 1.5, with the `anchor` texels (H, W).

    `texture_linear` and `normal` are (H, W, 3); anchors are skin. Light that changes its colour over
    the face does so with the normal (lamps, sky) or with the brightness (shadows that a second light fills):
    log chroma is fitted by both, robustly, so that neither makes skin something else.
    """
    weight = known.astype(np.float32)
    floor = max(_DARKEST * float(np.percentile(texture_linear[known].max(-1), 95)), 1e-9)
    logarithm = np.log(np.maximum(texture_linear, np.float32(floor)))
    brightness = np.where(known, logarithm.max(-1), 0)
    around = local_mean(brightness, weight, odd_side(_AROUND_MM / texel_mm))
    part_of_white = np.exp(brightness) * np.float32(_DARKEST / floor)
    # Contrast is against the mean and the median around: edges, of shadows or of moles, have it against one.
    # In the dark it is more, by a picture's noise.
    filled = np.where(known, brightness, around)
    edgeless = np.abs(filled - median_filter(filled, 5, mode="nearest"))
    contrast = np.minimum(edgeless, np.abs(filled - local_mean(filled, weight, 3)))
    own = float(np.median(contrast[anchor])) if anchor.any() else 0.0
    coarseness = max(1.0, texel_mm / _FINE_MM) ** 2
    least = float(np.clip(_SKIN_GRAIN * own, _LEAST_GRAIN * coarseness, _MOST_GRAIN))
    noise = np.sqrt(1 + (_SHADOW_GRAIN / np.maximum(part_of_white, np.float32(1e-3))) ** 2)
    rough = contrast > least * noise
    grain = local_mean(rough.astype(np.float32), weight, odd_side(_GRAIN_MM / texel_mm))
    return ColorEvidence(
        np.where(known, _chroma_distance(logarithm, normal, known, anchor), 0).astype(np.float32),
        np.where(known, grain, 0),
        np.where(known, np.maximum(around - brightness, 0), 0),
    )


def _chroma_distance(logarithm: Image, normal: Image, known: BoolArray, anchor: BoolArray) -> Image:
    """Return (H, W) the Mahalanobis distance of log R/G and log B/G from the face's skin."""
    chroma = logarithm[..., [0, 2]] - logarithm[..., [1]]
    level = logarithm.mean(-1)
    chosen = np.flatnonzero(known)
    chosen = chosen[:: -(-len(chosen) // _SAMPLES)]
    seen = chroma.reshape(-1, 2)[chosen].astype(np.float64)
    part = np.where(anchor.ravel()[chosen], 1.0, _BESIDE_ANCHORS)
    median = float(np.median(level.ravel()[chosen]))
    noise = np.exp(2 * (np.log(_QUANTIZATION) - level))
    # What the light's colour may turn with, the constant first.
    x, y, z = np.moveaxis(normal.astype(np.float32), -1, 0)
    bright = np.clip(level - median, -2.5, 1)
    basis = np.stack([np.ones_like(x), x, y, z, x * y, y * z, x * z, x * x - y * y, bright], -1)
    columns = basis.reshape(-1, basis.shape[-1])[chosen].astype(np.float64)
    skin, spread = _fitted_skin(seen, columns, part, noise.ravel()[chosen])
    rest = chroma - basis @ skin.astype(np.float32)
    distance: Image = np.sqrt((rest**2 / (spread**2 + noise[..., None])).sum(-1))
    return distance


def _fitted_skin(
    chroma: FloatArray, basis: FloatArray, part: FloatArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the coefficients (B, 2) of the skin's chroma and its standard deviations (2,).

    Iteratively reweighted least squares with a Gaussian prior on how the light's colour turns, from the
    most common chroma that skin may have: a mask or hair over half of the face must not be taken for it.
    """
    # The chroma with most texels around it, times how likely skin has it.
    candidates = chroma[part == part.max()]
    candidates = candidates[:: -(-len(candidates) // _CANDIDATES)]
    distance = ((chroma - candidates[:, None]) ** 2).sum(-1)
    support = np.exp(-0.5 * distance / _SAME_MATERIAL**2) @ part
    typical = np.exp(-0.5 * (((candidates - TYPICAL_CHROMA) / TYPICAL_SPREAD) ** 2).sum(1))
    start = candidates[np.argmax(support * (typical + 1e-3))]
    weight = part * np.exp(-0.5 * (((chroma - start) / _SAME_MATERIAL) ** 2).sum(1))
    skin, spread = np.zeros((basis.shape[1], 2)), _COARSEST
    # Texels side by side are not independent: so many count as one.
    prior = np.diag([0.0, *_LIGHT_COLOR**-2.0]) * (part.sum() / _INDEPENDENT)
    for _ in range(_ROUNDS):
        precision = weight[:, None] / (spread**2 + noise[:, None])
        for k, p in enumerate(precision.T):
            skin[:, k] = np.linalg.solve((basis.T * p) @ basis + prior, basis.T @ (p * chroma[:, k]))
        square = (chroma - basis @ skin) ** 2
        spread = np.clip(np.sqrt(np.average(square, axis=0, weights=weight)) * 1.15, _FINEST, _COARSEST)
        weight = part * np.exp(-0.5 * (square / (_REACH * spread) ** 2).sum(1))
    return skin, spread


def odd_side(texels: float) -> int:
    """Return the odd number of texels nearest to `texels`, at least 3."""
    return max(3, 2 * round((texels - 1) / 2) + 1)


def local_mean(field: Image, weight: Image, side: int) -> Image:
    """Return the weighted mean of `field` (H, W) over squares of `side` texels; 0 without any weight."""
    sums, total = (uniform_filter(f, side, mode="constant") for f in (field * weight, weight))
    return np.asarray(sums / np.maximum(total, np.float32(1e-6 / side**2)), np.float32)
