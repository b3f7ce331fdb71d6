"""Sharp outlines in the estimated light: each stays as far as the texture has it."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import binary_dilation, gaussian_filter

from scan2albedo.albedo.poisson import forward_differences, integrate_gradients
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.core.plan import PlanStep

_SHARP, _CLEAR = 0.06, 0.03
"""Steps of log light from a texel of a 512 x 512 chart to the next that make a sharp, a blurred outline."""
_SIDE = 512
_AROUND = 1 / 200
"""Standard deviation of the neighbourhood over which steps are compared, as a part of the chart's side."""
_SEEN, _HINTED = 0.75, 0.4
"""Parts of a sharp and of a blurred outline's steps that the texture has to show for it to stay as it is."""
_CHANCE, _MOST, _ABSENT = 0.15, 0.4, 0.3
"""Part of the outlines' length that texture and noise hide even where the light is right, the part up to
which lamps are trusted, and what of an outline's steps the texture then has to show."""
_BAND = 1 / 80
"""Half width of the band over which an outline that is not seen is spread, as a part of the chart's side."""
_DARK = 1e-4
"""Value below which logarithms are not taken."""


def seen_outlines(light: FloatArray, value: FloatArray, usable: BoolArray) -> tuple[FloatArray, PlanStep]:
    """Return the light (H, W) with outlines that V of the texture (H, W) does not show made soft; the row.

    Along a sharp outline the light's steps s and the texture's t are compared by least squares over a small
    neighbourhood: t ~ b s, where b is 1 for an outline that is there, and 0 for one that is not. Steps are
    scaled to b s, and the rest is spread over a band beside the outline (a Poisson equation, the light beyond
    the band as it was): a soft shadow instead of a hard one, and no line in the albedo.
    """
    stage = "albedo.outlines"
    log_light, log_value = (np.log(np.maximum(field, _DARK)) for field in (light, value))
    sharp, clear = (step * _SIDE / max(light.shape) for step in (_SHARP, _CLEAR))
    steps = forward_differences(log_light)
    # Slices of the first and the second texels of the pairs along each axis.
    every, before, after = slice(None), slice(None, -1), slice(1, None)
    ends = [((every, before), (every, after)), ((before, every), (after, every))]
    both = [usable[first] & usable[second] for first, second in ends]
    edges = [pair & (np.abs(step) > clear) for pair, step in zip(both, steps, strict=True)]
    if not any(edge.any() for edge in edges):
        return light, PlanStep(stage, False, "the light has no sharp outline", "0 texels")
    # The slope, from 0 to 1, of the texture's steps over the light's around each texel.
    common, square = np.zeros(light.shape), np.zeros(light.shape)
    for (first, _), s, t, edge in zip(ends, steps, forward_differences(log_value), edges, strict=True):
        # A step of the texture far larger than the light's is another thing: a hair, a rim.
        limited = np.clip(t, -2 * np.abs(s), 2 * np.abs(s))
        common[first] += np.where(edge, s * limited, 0)
        square[first] += np.where(edge, s * s, 0)
    sigma = _AROUND * max(light.shape)
    common, square = (gaussian_filter(field, sigma, mode="constant") for field in (common, square))
    seen = np.clip(common / np.maximum(square, 1e-12), 0, 1)
    shares = [0.5 * (seen[first] + seen[second]) for first, second in ends]
    unseen = [
        edge & (share < np.where(np.abs(step) > sharp, _SEEN, _HINTED))
        for share, step, edge in zip(shares, steps, edges, strict=True)
    ]
    part, length = (sum(int(edge.sum()) for edge in each) for each in (unseen, edges))
    evidence = f"the texture lacks {100 * part / length:.0f} % of {length} texels of sharp outlines"
    if part < _MOST * length:
        # Outlines that run a texel beside the texture's seem to be lacking in part.
        unseen = [edge & (share < _ABSENT) for share, edge in zip(shares, edges, strict=True)]
    if part < _CHANCE * length or not any(edge.any() for edge in unseen):
        return light, PlanStep(stage, False, "the texture has the outlines of the light", evidence)
    wrong, wanted = np.zeros(light.shape, bool), []
    for (first, second), step, share, edge in zip(ends, steps, shares, unseen, strict=True):
        wanted.append(np.where(edge, share * step, step))
        wrong[first] |= edge
        wrong[second] |= edge
    band = binary_dilation(wrong, iterations=max(1, round(_BAND * max(light.shape)))) & usable
    spread = integrate_gradients(log_light, band, usable & ~band, wanted[0], wanted[1])
    reason = "outlines that the texture does not show are spread"
    return np.where(band, np.exp(spread), light), PlanStep(stage, True, reason, evidence)
