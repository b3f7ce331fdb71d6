"""Texture told from colour: pigment changes hue and brightness together, white light only brightness."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scan2albedo.albedo.levels import Level, local_mean

FloatArray = NDArray[np.float64]

_ROUNDS = 8
_ROBUST = 0.01
"""Differences of log V beyond which a pair counts as an outlier."""
_LOWEST = 1 / 8
"""Hues are taken relative to their mean under a Gaussian of this part of the chart: slower changes may be
coloured light."""
_LARGEST = 3.0
"""Bound of the predicted log albedo."""
_LEFT_OF_HIGHLIGHT = 0.02
"""Part of a cell that at least remains below a highlight."""


@dataclass(frozen=True)
class ColorGuide:
    """`albedo` (N,) > 0: V that colour predicts, about 1; `explained`: part of log V's local change."""

    albedo: FloatArray
    explained: float

    @classmethod
    def none(cls, size: int) -> ColorGuide:
        """Return the guide that predicts nothing."""
        return cls(np.ones(size), 0.0)


def color_guide(level: Level, specular: FloatArray | None = None) -> ColorGuide:
    """Return what the hues of the cells tell about V of their albedo.

    Between neighbouring cells the light is nearly the same, so there log V changes with the albedo alone. Its
    dependence on the two log ratios of the channels is fitted to such pairs (robust, linear: exact where
    one pigment of varying density colours the surface), and applied to the ratios' deviation from
    their mean around.

    Parameters
    ----------
    level : Level
    specular : (N,) float64, optional
        A white highlight, in the unit of the level's value; taken off first.

    References
    ----------
    .. [1] B. Funt, M. Drew, M. Brockington, "Recovering shading from color images", ECCV 1992.
    .. [2] N. Tsumura, H. Haneishi, Y. Miyake, "Independent-component analysis of skin color image",
       JOSA A 16(9), 1999: log reflectance of skin is linear in two pigments.
    """
    color, value = level.color, level.value
    if specular is not None:
        color = np.maximum(color - specular[:, None], _LEFT_OF_HIGHLIGHT * color)
        value = np.maximum(value - specular, _LEFT_OF_HIGHLIGHT * value)
    log_color = np.log(np.maximum(color, 1e-5))
    log_value = np.log(np.maximum(value, 1e-6))
    ratios = log_color[:, 1:] - log_color[:, :1]
    first, second = _neighbours(level)
    rise, change = log_value[first] - log_value[second], ratios[first] - ratios[second]
    brightness = np.minimum(value[first], value[second])
    slope, rest = _robust_slope(change, rise, brightness)
    before, after = (float(brightness @ np.abs(d)) for d in (rise, rest))
    explained = 1 - after / before if before > 0 else 0.0
    sigma = _LOWEST * float(level.cell.max() + 1)
    deviation = ratios - np.stack([local_mean(level, ratios[:, k], sigma) for k in range(2)], 1)
    return ColorGuide(np.exp(np.clip(deviation @ slope, -_LARGEST, _LARGEST)), explained)


def _neighbours(level: Level) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the cells of each pair that lies side by side or one above the other."""
    row, column = level.cell.T
    index = np.full((row.max() + 1, column.max() + 1), -1)
    index[row, column] = np.arange(len(row))
    pairs = []
    for a, b in ((index[:, :-1], index[:, 1:]), (index[:-1], index[1:])):
        both = (a >= 0) & (b >= 0)
        pairs.append(np.stack([a[both], b[both]]))
    first, second = np.concatenate(pairs, 1)
    return first, second


def _robust_slope(change: FloatArray, rise: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return (2,) the slope of `rise` (M,) over `change` (M, 2) and what it leaves (M,)."""
    slope, rest = np.zeros(2), np.asarray(rise)
    for _ in range(_ROUNDS):
        w = (weight / np.hypot(rest, _ROBUST))[:, None] * change
        matrix = w.T @ change
        matrix += 1e-9 * max(float(np.trace(matrix)), 1e-12) * np.eye(2)
        slope = np.asarray(np.linalg.solve(matrix, w.T @ rise), np.float64)
        rest = np.asarray(rise - change @ slope, np.float64)
    return slope, rest
