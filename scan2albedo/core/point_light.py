"""`PointLight`: a flash on a sphere around the face, or a distant light."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class PointLight:
    """One light source in the model's frame.

    Parameters
    ----------
    azimuth_rad : float
        From +z toward +x.
    elevation_rad : float
        From the xz-plane toward +y.
    distance_mm : float
        Distance from the model's origin; ``inf`` is a distant light without falloff.
    intensity : float
        Irradiance factor relative to ambient = 1 at the origin's distance: a surface there facing the
        light gets `intensity`, and (distance_mm / r)^2 of it at distance r from the light.

    Raises
    ------
    ValueError
        For angles or an intensity that are not finite, a negative intensity, or a distance that is not above
        0.
    """

    azimuth_rad: float
    elevation_rad: float
    distance_mm: float = math.inf
    intensity: float = 1.0

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, (self.azimuth_rad, self.elevation_rad, self.intensity))):
            raise ValueError(f"{self}: angles and intensity must be finite")
        if self.intensity < 0:
            raise ValueError(f"{self}: intensity must be 0 or more; to take light away lower the ambient one")
        if not self.distance_mm > 0:
            raise ValueError(f"{self}: distance_mm must be above 0; inf is a distant light")

    @property
    def direction(self) -> NDArray[np.float64]:
        """(3,) unit vector from the origin toward the light."""
        horizontal = math.cos(self.elevation_rad)
        return np.array(
            [
                horizontal * math.sin(self.azimuth_rad),
                math.sin(self.elevation_rad),
                horizontal * math.cos(self.azimuth_rad),
            ]
        )
