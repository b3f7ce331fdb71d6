"""How strong each flash was, channel by channel, found in turn with the reflectance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core import Meter
from scan2albedo.reflectance.fit_options import ReflectanceFitOptions
from scan2albedo.reflectance.robust_fit import Observations, RobustFit, fit_rows

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_LEAST, _MOST = 1e-3, 1e3
"""Gains are kept between these: a flash that lit only black pixels would have none."""


def divided_by_gain(data: Observations, light: IntArray, gain: FloatArray) -> Observations:
    """Return observations as under flashes of gain 1: y / g, with precision g^2 / sigma^2."""
    factor = np.where(np.isfinite(gain), gain, 1.0)[light][:, None, :]
    return replace(data, observed=data.observed / factor, precision=data.precision * factor**2)


def find_light_gains(
    data: Observations, light: IntArray, rows: IntArray, options: ReflectanceFitOptions, meter: Meter
) -> tuple[FloatArray, bool]:
    """Return gains (L, 3), mean 1 over the flashes that lit something (NaN for the others), and convergence.

    Reflectance for fixed gains and gains for fixed reflectance are found in turn, g = sum u p y m / sum u p
    m^2 over a flash's observations y of radiance m, with the robust weights u; gain times reflectance is one
    scale a channel, fixed by the mean.
    """
    few = rows[:: max(1, len(rows) // options.gain_vertices)]
    subset = replace(
        data, observed=data.observed[:, few], precision=data.precision[:, few], lobes=data.lobes[:, few]
    )
    every = np.arange(len(few))
    gain = np.ones((int(light.max()) + 1, 3))
    for _ in range(options.gain_iterations):
        fitted = fit_rows(divided_by_gain(subset, light, gain), every, options, meter.unseen_child())
        meter.count()
        new = _gains(subset, light, fitted, len(gain))
        step = float(np.nanmax(np.abs(new - gain)))
        gain = new
        if step < options.gain_tolerance:
            return gain, True
        if meter.exhausted:
            break
    return gain, False


def _gains(data: Observations, light: IntArray, fitted: RobustFit, count: int) -> FloatArray:
    estimate, precision = fitted.estimate, data.precision * fitted.weight[..., None]
    above, below = np.zeros((count, 3)), np.zeros((count, 3))
    gloss = np.einsum("jvs,vs->jv", data.lobes[..., 1:], estimate[:, 3:])
    radiance = data.lobes[..., :1] * estimate[:, :3] + gloss[..., None]
    np.add.at(above, light, (precision * data.observed * radiance).sum(1))
    np.add.at(below, light, (precision * radiance**2).sum(1))
    gain = np.where(below > 0, np.clip(above / np.where(below > 0, below, 1.0), _LEAST, _MOST), np.nan)
    return np.asarray(gain / np.nanmean(gain, axis=0), np.float64)
