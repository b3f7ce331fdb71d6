"""Light as spherical harmonics of order 2: nine coefficients for each channel, neither shadows nor lamps."""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from scan2albedo.albedo.levels import Level, build_level
from scan2albedo.albedo.options import EstimateOptions
from scan2albedo.albedo.soft_terms import DARKEST
from scan2albedo.core import Meter
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.core.geometry_image import GeometryImage
from scan2albedo.lighting.harmonics import harmonics


def fit_harmonic_light(
    image: GeometryImage, usable: BoolArray, options: EstimateOptions, meter: Meter
) -> FloatArray:
    """Return (9, 3) coefficients of the shading of each channel, each of mean 1 over the usable texels.

    Minimises sum rho(w (T - a_b Y c) / mean T) over c, with the block albedos a_b eliminated and rho the soft
    L1 loss. The colours of light and albedo cannot be separated: hence the mean of 1.

    .. [1] R. Basri, D. Jacobs, "Lambertian reflectance and linear subspaces", IEEE TPAMI 25(2), 2003.
    """
    assert image.texture_linear is not None
    channels = [
        build_level(image, usable, options.sizes[2], values=image.texture_linear[..., channel])
        for channel in range(3)
    ]
    return np.stack([_fit_channel(level, meter) for level in channels], 1)


def _fit_channel(level: Level, meter: Meter) -> FloatArray:
    """Return (9,) the coefficients of one channel."""
    basis = harmonics(level.normal, 2)
    mean = np.average(basis, axis=0, weights=level.weight)
    root, (blocks, count) = np.sqrt(level.weight), level.blocks()

    def complete(free: FloatArray) -> FloatArray:
        # The constant is chosen so that the mean shading is 1.
        return np.concatenate([[(1 - mean[1:] @ free) / mean[0]], free])

    def residual(free: FloatArray) -> FloatArray:
        meter.count()
        light = np.maximum(basis @ complete(free), DARKEST)
        parts = []
        for block in blocks:
            top = np.bincount(block, level.weight * level.value * light, count)
            bottom = np.bincount(block, level.weight * light**2, count)
            parts.append(root * (level.value - light * (top / np.maximum(bottom, 1e-12))[block]))
        return np.concatenate(parts)

    free = np.zeros(basis.shape[1] - 1)
    # A few steps at a time, so that a budget can end the fit between them.
    while not meter.exhausted:
        step = least_squares(residual, free, loss="soft_l1", f_scale=0.05, max_nfev=8)
        moved = float(np.abs(step.x - free).max())
        free = step.x
        meter.record(float(np.mean(np.abs(step.fun))))
        if moved < 1e-5:
            return complete(free)
    if not meter.rows:
        meter.record(float(np.mean(np.abs(residual(free)))))
    return complete(free)


def harmonic_shading(image: GeometryImage, coefficients: FloatArray) -> FloatArray:
    """Return (H, W, 3) the shading of each channel, floored; 1 outside the mask."""
    shading = np.ones((*image.shape, 3))
    lit = harmonics(image.normal[image.mask], 2) @ coefficients
    shading[image.mask] = np.maximum(lit, DARKEST)
    return shading
