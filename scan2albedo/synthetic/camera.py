"""What a camera makes of light: exposure, noise, clipping, sRGB encoding and quantisation."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]

BRIGHTEST = 0.98
"""Level of the brightest pixel at exposure 1."""


def auto_exposure(radiance_linear: ArrayLike) -> float:
    """Return the factor that puts the brightest value of the picture just below white."""
    brightest = float(np.max(radiance_linear))
    return BRIGHTEST / brightest if brightest > 0 else 1.0


def photograph(
    radiance_linear: ArrayLike, *, exposure: float, noise: float, bits: int | None, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Return the linear picture decoded from what the camera stored.

    Parameters
    ----------
    radiance_linear : array_like of float
        Any shape.
    exposure : float
        Factor from radiance to the sensor's scale, where 1 is white.
    noise : float
        Standard deviation of Gaussian noise on the sensor's linear scale.
    bits : int or None
        Quantise the sRGB-encoded picture to 2^bits levels; None keeps it as it is (still clipped).
    rng : numpy.random.Generator
        Of the noise.
    """
    sensor = np.asarray(radiance_linear, np.float32) * np.float32(exposure)
    if noise > 0:
        sensor += np.float32(noise) * rng.standard_normal(sensor.shape, dtype=np.float32)
    sensor = np.clip(sensor, 0, 1)
    if bits is None:
        return sensor
    levels = 2**bits - 1
    stored = np.round(encode_srgb(sensor) * levels).astype(np.int64)
    return decode_srgb(np.arange(levels + 1) / levels).astype(np.float32)[stored]


def encode_srgb(linear: ArrayLike) -> FloatArray:
    """Return sRGB values of linear ones in [0, 1] (IEC 61966-2-1)."""
    x = np.asarray(linear)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 0.0031308) ** (1 / 2.4) - 0.055)


def decode_srgb(encoded: ArrayLike) -> FloatArray:
    """Return linear values of sRGB ones in [0, 1] (IEC 61966-2-1).

    >>> bool(abs(decode_srgb(encode_srgb(0.5)) - 0.5) < 1e-12)
    True
    """
    x = np.asarray(encoded, float)
    return np.where(x <= 0.04045, x / 12.92, ((np.maximum(x, 0.04045) + 0.055) / 1.055) ** 2.4)
