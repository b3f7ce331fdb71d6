"""What others do about light in a photograph: filters, and spherical harmonics, as their authors give them.

All take and return V (H, W) of a geometry image; scale is unknown to all of them.
"""

from __future__ import annotations

import numpy as np
from bench.judging import robust_light

from benchmarks.light_normalization import DARKEST, blurred_inside
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.lighting.harmonics import harmonics


def homomorphic(value: FloatArray, mask: BoolArray, sigma: float = 1 / 8) -> FloatArray:
    """Take the low frequencies out of log V: a Gaussian of `sigma` of the image's side.

    References
    ----------
    .. [1] A. Oppenheim, R. Schafer, T. Stockham, "Nonlinear Filtering of Multiplied and Convolved Signals",
       Proceedings of the IEEE 56(8), 1968.
    """
    log = np.log(np.maximum(value, DARKEST))
    return np.where(mask, np.exp(log - blurred_inside(log, mask, sigma * max(mask.shape))), 0)


def robust_harmonics(
    value: FloatArray, normal: FloatArray, mask: BoolArray, iterations: int = 30
) -> FloatArray:
    """Divide by nine spherical harmonics of the normal, fitted with L1 (iteratively reweighted).

    References
    ----------
    .. [1] R. Basri, D. Jacobs, "Lambertian Reflectance and Linear Subspaces", PAMI 25(2), 2003.
    """
    albedo = np.zeros(mask.shape)
    albedo[mask] = value[mask] / robust_light(harmonics(normal[mask], 2), value[mask], iterations)
    return albedo
