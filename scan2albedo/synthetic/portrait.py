"""Where cameras and lights stand around a synthetic head, and the values that a camera stores."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from scan2albedo.geometry.pinhole import look_at

FloatArray = NDArray[np.float64]

TARGET_MM = np.array([0.0, 0.0, -5.0])
"""Point of the head in the middle of pictures."""


def toward(azimuth_deg: float, elevation_deg: float) -> FloatArray:
    """Return the unit vector (3,) from the head: azimuth from +z toward +x, elevation toward +y."""
    azimuth, elevation = math.radians(azimuth_deg), math.radians(elevation_deg)
    across = math.cos(elevation)
    return np.array([math.sin(azimuth) * across, math.sin(elevation), math.cos(azimuth) * across])


def focal_length_px(size: int, distance_mm: float, reach_mm: float) -> float:
    """Return the focal length of pictures of `size` pixels that span twice `reach_mm` at `distance_mm`."""
    return size * distance_mm / (2 * reach_mm)


def portrait_camera(
    azimuth_deg: float, elevation_deg: float, *, size: int, distance_mm: float, reach_mm: float
) -> FloatArray:
    """Return the (3, 4) camera that looks at the head from a direction."""
    focal = focal_length_px(size, distance_mm, reach_mm)
    position = TARGET_MM + distance_mm * toward(azimuth_deg, elevation_deg)
    return look_at(position, TARGET_MM, focal_px=focal, shape=(size, size))


def exposure_for(brightest: FloatArray, saturated_part: float) -> float:
    """Return the factor that makes this part of the pixels brighter than white; 1 for black pictures."""
    white = float(np.quantile(brightest, 1 - saturated_part)) if len(brightest) else 0.0
    return 1 / white if white > 0 else 1.0


def stored_values(
    linear: NDArray[np.float32], *, gamma: float, noise: float, bits: int | None, rng: np.random.Generator
) -> NDArray[np.generic]:
    """Return the values light^(1 / gamma) with noise; clipped and rounded to 8 or 16 bits, or as they are.

    Parameters
    ----------
    linear : (H, W, 3) float32
        Light, white = 1.
    gamma : float
    noise : float
        Standard deviation of the values.
    bits : {8, 16, None}
    rng : numpy.random.Generator
    """
    values = linear ** np.float32(1 / gamma)
    values += np.float32(noise) * rng.standard_normal(values.shape, dtype=np.float32)
    if bits is None:
        return values
    kind = np.uint8 if bits == 8 else np.uint16
    return np.round(np.clip(values, 0, 1) * np.iinfo(kind).max).astype(kind)
