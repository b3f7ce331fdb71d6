"""`PointLight`: a flash on a sphere around the face, or a distant light."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

LAMP_RADIUS_DEG = 4.0
"""Angular radius of a usual lamp for portraits: 30 cm across, two metres away."""


@dataclass(frozen=True)
class PointLight:
    """One light source in the model's frame.

    Raises ValueError for angles or an intensity that are not finite, a negative intensity, a distance that is
    not above 0, a colour that is negative or not of mean 1, or a radius outside 0 to 90 degrees.
    """

    azimuth_rad: float
    """From +z toward +x."""
    elevation_rad: float
    """From the xz-plane toward +y."""
    distance_mm: float = math.inf
    """Distance from the model's origin; ``inf`` is a distant light without falloff."""
    intensity: float = 1.0
    """Irradiance factor relative to ambient = 1 at the origin's distance: a surface there facing the light
    gets `intensity`, and (distance_mm / r)^2 of it at distance r from the light."""
    color_linear: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Of its light, red, green, blue, of mean 1: `intensity` is the mean over the channels."""
    radius_deg: float = 0.0
    """Angular radius as seen from the face: how soft its shadows are. 0 is a point."""

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, (self.azimuth_rad, self.elevation_rad, self.intensity))):
            raise ValueError(f"{self}: angles and intensity must be finite")
        if self.intensity < 0:
            raise ValueError(f"{self}: intensity must be 0 or more; to take light away lower the ambient one")
        if not self.distance_mm > 0:
            raise ValueError(f"{self}: distance_mm must be above 0; inf is a distant light")
        color = self.color_linear
        if len(color) != 3 or not (min(color) >= 0 and round(sum(color) / 3 - 1, 5) == 0):
            raise ValueError(f"{self}: color_linear must be three numbers, 0 or more, whose mean is 1")
        if not 0 <= self.radius_deg < 90:
            raise ValueError(f"{self}: radius_deg must be from 0, a point, to below 90")

    @property
    def white(self) -> bool:
        """Whether its light is the same in all channels."""
        return self.color_linear == (1.0, 1.0, 1.0)

    @property
    def direction(self) -> NDArray[np.float64]:
        """(3,) unit vector from the origin toward the light."""
        horizontal, up = math.cos(self.elevation_rad), math.sin(self.elevation_rad)
        right, forward = horizontal * math.sin(self.azimuth_rad), horizontal * math.cos(self.azimuth_rad)
        return np.array([right, up, forward])
