"""Light as spherical harmonics of order 2: nine coefficients for each channel, neither shadows nor lamps."""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from scan2albedo.albedo.levels import Level, build_level
from scan2albedo.albedo.lit_image import LitImage
from scan2albedo.albedo.soft_terms import DARKEST
from scan2albedo.albedo.texel_light import TexelLight
from scan2albedo.core import Meter
from scan2albedo.core.arrays import FloatArray
from scan2albedo.lighting.environment_light import environment_of_shading
from scan2albedo.lighting.harmonics import harmonics
from scan2albedo.lighting.shading import Reflectance


def harmonic_light(scene: LitImage) -> TexelLight:
    """Return light as harmonics that nothing hides, of each channel's mean 1 over the usable texels.

    Minimises sum rho(w (T - a_b Y c) / mean T) over each channel's coefficients c, with the block albedos a_b
    eliminated and rho the soft L1 loss. The colours of light and albedo cannot be separated: hence the mean.

    .. [1] R. Basri, D. Jacobs, "Lambertian reflectance and linear subspaces", IEEE TPAMI 25(2), 2003.
    """
    image, size = scene.image, scene.options.sizes[2]
    assert image.texture_linear is not None
    channels = np.moveaxis(image.texture_linear, -1, 0)
    levels = [build_level(image, scene.usable, size, channel) for channel in channels]
    coefficients = np.stack([_fit_channel(level, scene.meter) for level in levels], 1)
    light = np.maximum(harmonics(image.normal[image.mask], 2) @ coefficients, DARKEST)
    nothing, environment = np.zeros_like(light), environment_of_shading(coefficients)
    seen, deviation = np.ones(len(light)), np.zeros(len(light))
    return TexelLight(light, nothing, seen, deviation, (), environment, Reflectance("lambert"))


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
