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
    """

    azimuth_rad: float
    elevation_rad: float
    distance_mm: float = math.inf
    intensity: float = 1.0

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
