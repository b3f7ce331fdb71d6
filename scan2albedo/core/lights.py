"""`PointLight`, near or distant, and `EnvironmentLight`, soft light from all around a face."""

import math
from dataclasses import dataclass
from typing import Self

import numpy as np

from scan2albedo.core.arrays import FloatArray, checked_array

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
    def direction(self) -> FloatArray:
        """(3,) unit vector from the origin toward the light."""
        horizontal, up = math.cos(self.elevation_rad), math.sin(self.elevation_rad)
        right, forward = horizontal * math.sin(self.azimuth_rad), horizontal * math.cos(self.azimuth_rad)
        return np.array([right, up, forward])


@dataclass(frozen=True, eq=False)
class EnvironmentLight:
    """Soft light of low frequency in the model's frame.

    Its radiance is L(d) = sum_k c_k Y_k(d) / Y_0. White surfaces that nothing hides have the light c_0 on
    average over their directions: (1, 1, 1) is the constant ambient light of 1.

    Raises ValueError for coefficients of another shape or not finite, or for strengths outside their ranges.

    >>> EnvironmentLight.constant().coefficients[0].tolist()
    [1.0, 1.0, 1.0]
    """

    coefficients: FloatArray
    """(9, 3): c of each channel, in the order of `lighting.harmonics`; stored as float64."""
    occluded: bool = True
    """Whether the surface hides part of it from itself."""
    fill: float = 0.0
    """Part in [0, 1] of the hidden constant light that comes back: from walls, or through the surface."""
    bounce: float = 0.0
    """Albedo of the surface that throws light onto itself; 0 or more."""

    def __post_init__(self) -> None:
        coefficients = checked_array(self.coefficients, (9, 3), "coefficients", finite=ValueError)
        if not 0 <= self.fill <= 1:
            raise ValueError(f"fill is {self.fill}, expected a part from 0 to 1 of what is hidden")
        if not 0 <= self.bounce < np.inf:
            raise ValueError(f"bounce is {self.bounce}, expected a finite number, 0 or more")
        object.__setattr__(self, "coefficients", coefficients.copy())

    @classmethod
    def constant(cls) -> Self:
        """Return white light of 1 from everywhere that nothing hides: the paper's ambient light."""
        coefficients = np.zeros((9, 3))
        coefficients[0] = 1.0
        return cls(coefficients, occluded=False)
