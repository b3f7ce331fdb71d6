"""Synthetic cameras: where they stand around a head, and what they store of light."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scan2albedo.core.arrays import FloatArray
from scan2albedo.geometry.pinhole import look_at
from scan2albedo.io.color import encoded_srgb, srgb_to_linear

TARGET_MM = np.array([0.0, 0.0, -5.0])
"""Point of the head in the middle of portraits."""


def auto_exposure(radiance_linear: ArrayLike) -> float:
    """Return the factor that puts the brightest value of the picture just below white."""
    brightest = float(np.max(radiance_linear))
    return 0.98 / brightest if brightest > 0 else 1.0


def photograph(
    radiance_linear: ArrayLike, *, exposure: float, noise: float, bits: int | None, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Return the linear picture decoded from what the camera stored of radiance of any shape.

    The sensor sees `exposure` times the radiance, 1 being white, with Gaussian noise of standard deviation
    `noise`. The sRGB-encoded picture is rounded to 2^bits levels; None leaves it unrounded, but clipped.
    """
    sensor = np.asarray(radiance_linear, np.float32) * np.float32(exposure)
    if noise > 0:
        sensor += np.float32(noise) * rng.standard_normal(sensor.shape, dtype=np.float32)
    sensor = np.clip(sensor, 0, 1)
    if bits is None:
        return sensor
    levels = 2**bits - 1
    # In float32, as the picture is: half the memory, and the same bits as ever.
    stored = np.round(encoded_srgb(sensor) * levels).astype(np.int64)
    return srgb_to_linear(np.arange(levels + 1) / levels).astype(np.float32)[stored]


def toward(azimuth_deg: float, elevation_deg: float) -> FloatArray:
    """Return the unit vector (3,) from the head: azimuth from +z toward +x, elevation toward +y."""
    azimuth, elevation = math.radians(azimuth_deg), math.radians(elevation_deg)
    across = math.cos(elevation)
    return np.array([math.sin(azimuth) * across, math.sin(elevation), math.cos(azimuth) * across])


@dataclass(frozen=True, kw_only=True)
class Portrait:
    """A camera before a person; ValueError for a value outside its range."""

    picture_size: int = 256
    """Height and width in pixels."""
    reach_mm: float = 130.0
    """Half of what a picture spans at the head."""
    distance_mm: float = 1000.0
    """Of the camera from the head."""
    gamma: float = 1.2
    """Values are light^(1 / gamma)."""
    noise: float = 0.01
    """Standard deviation of the values, white = 1."""
    bits: int | None = 8
    """8, 16, or None for values that are neither rounded nor clipped."""
    saturated_part: float = 0.002
    """Part of the face's pixels in all pictures that is brighter than white."""

    def __post_init__(self) -> None:
        refuse_outside(1, picture_size=self.picture_size)
        refuse_outside(0, noise=self.noise)
        for name in ("reach_mm", "distance_mm", "gamma"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} is {getattr(self, name)}, expected > 0 and finite")
        if not 0 <= self.saturated_part < 1:
            raise ValueError(f"saturated_part is {self.saturated_part}, expected in [0, 1)")
        if self.bits not in (8, 16, None):
            raise ValueError(f"bits is {self.bits}, expected 8, 16 or None")

    @property
    def focal_px(self) -> float:
        """Focal length."""
        return self.picture_size * self.distance_mm / (2 * self.reach_mm)

    def camera(self, azimuth_deg: float, elevation_deg: float) -> FloatArray:
        """Return the (3, 4) camera that looks at the head from a direction."""
        position = TARGET_MM + self.distance_mm * toward(azimuth_deg, elevation_deg)
        shape = (self.picture_size, self.picture_size)
        return look_at(position, TARGET_MM, focal_px=self.focal_px, shape=shape)

    def exposure(self, brightest: FloatArray) -> float:
        """Return the factor that saturates `saturated_part` of the face's pixels; 1 for black pictures."""
        white = float(np.quantile(brightest, 1 - self.saturated_part)) if len(brightest) else 0.0
        return 1 / white if white > 0 else 1.0

    def stored(self, linear: NDArray[np.floating], rng: np.random.Generator) -> NDArray[np.generic]:
        """Return the values that the camera stores of light (H, W, 3), white = 1, with its noise."""
        values = linear ** np.float32(1 / self.gamma)
        values += np.float32(self.noise) * rng.standard_normal(values.shape, dtype=np.float32)
        if self.bits is None:
            return values
        kind = np.uint8 if self.bits == 8 else np.uint16
        return np.round(np.clip(values, 0, 1) * np.iinfo(kind).max).astype(kind)


def refuse_outside(least: int, **values: float) -> None:
    """Raise ValueError unless all values are finite and `least` or more."""
    for name, value in values.items():
        if not least <= value < math.inf:
            raise ValueError(f"{name} is {value}, expected >= {least} and finite")
