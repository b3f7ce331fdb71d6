"""Texture predicted from colour: pigment changes hue and brightness together, white light only brightness."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from scan2albedo.albedo.levels import Level, local_mean
from scan2albedo.core.arrays import FloatArray

_ROUNDS = 8
_ROBUST = 0.01
"""Changes of log V beyond which a cell counts as an outlier."""
_WIDEST = 1 / 32
"""Standard deviation, as a part of the chart's side, of the widest Gaussian whose band the slope is fitted
to: in wider ones light changes too."""
_LOWEST = 1 / 8
"""Hues are taken relative to their mean under a Gaussian of this part of the chart: slower changes may be
coloured light."""
_CLEAR = 0.8
"""Part of the prediction's variance that is not noise, beyond which an octave's slope serves wider ones."""
_LARGEST = 3.0
"""Bound of the predicted log albedo."""
_LEFT_OF_HIGHLIGHT = 0.02
"""Part of a cell that at least remains below a highlight."""
_LIT = 0.02
"""Median brightness, as a part of V's, of a channel that is used: a darker one is offset and rounding,
which do not follow the light."""
_BLACK = 1e-3
"""Parts of the median below which logarithms are not taken."""
MIN_EXPLAINED = 0.12
"""Part of log V's local change that hue has to explain to be used."""


@dataclass(frozen=True)
class ColorGuide:
    """`albedo` (N,) > 0: V that colour predicts, about 1; `explained`: part of log V's local change."""

    albedo: FloatArray
    explained: float

    @classmethod
    def none(cls, size: int) -> ColorGuide:
        """Return the guide that predicts nothing."""
        return cls(np.ones(size), 0.0)


def color_guide(
    level: Level,
    specular: FloatArray | None = None,
    tint: FloatArray | None = None,
    *,
    min_explained: float = MIN_EXPLAINED,
) -> ColorGuide:
    """Return how V of the cells' albedo follows from their hues.

    Within a few cells the light is nearly the same, so there log V changes with the albedo alone. Its
    dependence on the two log ratios of the channels (linear: exact where one pigment of varying density
    colours the surface) is fitted robustly, octave by octave of the texture: noise hides the finest ones
    first. Noise that V and the ratios share predicts nothing and is taken off, so each slope is the best
    predictor from ratios as noisy as they are. A white highlight `specular` (N,), in the unit of the level's
    value, is taken off first, and the colours are divided by `tint` (N, 3), which coloured light gave them.
    A guide that explains less than `min_explained` of the local change of V predicts nothing.

    .. [1] B. Funt, M. Drew, M. Brockington, "Recovering shading from color images", ECCV 1992.
    .. [2] N. Tsumura, H. Haneishi, Y. Miyake, "Independent-component analysis of skin color image",
       JOSA A 16(9), 1999: log reflectance of skin is linear in two pigments.
    .. [3] W. Fuller, "Measurement error models", Wiley 1987, chapter 2.
    """
    color, value = level.color, level.value
    if specular is not None:
        color = np.maximum(color - specular[:, None], _LEFT_OF_HIGHLIGHT * color)
        value = np.maximum(value - specular, _LEFT_OF_HIGHLIGHT * value)
    if tint is not None:
        color = color / tint
    bright = np.flatnonzero(np.median(color, 0) >= _LIT * np.median(value))
    if len(bright) < 2:
        return ColorGuide.none(len(value))
    variance = _noise_variance(level, color) if len(bright) == 3 else 0.0
    color = color[:, bright]
    least = max(math.sqrt(variance), _BLACK)
    logs = np.log(np.maximum(np.column_stack([color, value]), least))
    # The noise's variances in the log channels, and its covariances with log V, which is one of them.
    noise = variance / (np.maximum(color, least) ** 2 * level.weight[:, None])
    shared = np.where(np.arange(len(bright)) == np.abs(color - value[:, None]).argmin(1)[:, None], noise, 0.0)
    side = float(level.cell.max() + 1)
    # Log ratios, log V, and the part of white noise's variance between two Gaussians, the finest first.
    octaves, smoothed, sigma = [], 0.0, 1.0
    while sigma <= max(_WIDEST * side, 1.0):
        smooth, wider = local_mean(level, logs, sigma), math.hypot(smoothed, sigma)
        band, inner, outer = logs - smooth, smoothed**2, wider**2
        passed = 1 - 3 / (4 * math.pi * outer)
        if inner > 0:
            passed = (1 / inner + 1 / outer - 4 / (inner + outer)) / (4 * math.pi)
        octaves.append((band[:, 1:-1] - band[:, :1], band[:, -1], passed))
        logs, smoothed, sigma = smooth, wider, 2 * sigma
    predicted, slope, clear = np.zeros(len(value)), np.zeros(len(bright) - 1), 0.0
    for octave in octaves:
        if clear < _CLEAR:
            slope, clear = _robust_slope(*octave, noise, shared, value)
        predicted += octave[0] @ slope
    change = np.sum([octave[1] for octave in octaves], 0)
    before, after = (float(value @ np.abs(d)) for d in (change, change - predicted))
    explained = 1 - after / before if before > 0 else 0.0
    if explained < min_explained:
        return ColorGuide.none(len(value))
    wide = logs - local_mean(level, logs, _LOWEST * side)
    predicted += (wide[:, 1:-1] - wide[:, :1]) @ slope
    return ColorGuide(np.exp(np.clip(predicted, -_LARGEST, _LARGEST)), explained)


def _noise_variance(level: Level, color: FloatArray) -> float:
    """Return the variance of the noise of one channel of a cell.

    One or two pigments leave a direction among the channels in which little but noise changes. Of the changes
    there, noise is the part that differs as much from one cell to the next as over two.
    """
    grain = color - local_mean(level, color, 1.0)
    least = np.linalg.eigh(grain.T @ grain)[1][:, 0]
    field = np.full(level.cell.max(0) + 1, np.nan)
    field[tuple(level.cell.T)] = color @ least
    squares = []
    for lag in (1, 2):
        differences = np.concatenate(
            [(field[:, lag:] - field[:, :-lag]).ravel(), (field[lag:] - field[:-lag]).ravel()]
        )
        known = np.abs(differences[np.isfinite(differences)])
        squares.append(float(known.mean()) ** 2 if len(known) else 0.0)
    near, far = squares
    # The mean of a Gaussian |difference|, squared, is 4 / pi of the variance of either side.
    return max(2 * near - far, 0.0) * math.pi / 4


def _robust_slope(
    ratios: FloatArray,
    value: FloatArray,
    passed: float,
    noise: FloatArray,
    shared: FloatArray,
    brightness: FloatArray,
) -> tuple[FloatArray, float]:
    """Return (C - 1,) the slope of log V over the log ratios, and how much of its prediction is not noise.

    `noise`, `shared` (N, C): variances of the noise in the log channels, covariances with log V.
    """
    slope, rest, clear = np.zeros(ratios.shape[1]), value, 0.0
    for _ in range(_ROUNDS):
        weight = brightness / np.hypot(rest, _ROBUST)
        own, common = passed * (weight @ noise), passed * (weight @ shared)
        matrix = (weight[:, None] * ratios).T @ ratios
        matrix += 1e-9 * max(float(np.trace(matrix)), 1e-12) * np.eye(len(slope))
        slope = np.linalg.solve(matrix, ratios.T @ (weight * value) - (common[1:] - common[0]))
        rest = value - ratios @ slope
        predicted = max(float(slope @ matrix @ slope), 1e-30)
        clear = 1 - float(own[1:] @ slope**2 + own[0] * slope.sum() ** 2) / predicted
    return np.asarray(slope, np.float64), clear
