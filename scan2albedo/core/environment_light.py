"""`EnvironmentLight`: soft light from all around a face, as spherical harmonics of its radiance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class EnvironmentLight:
    """Soft light of low frequency in the model's frame.

    Its radiance is L(d) = sum_k c_k Y_k(d) / Y_0. White surfaces that nothing hides have the light c_0 on
    average over their directions: (1, 1, 1) is the constant ambient light of 1.

    Raises ValueError for coefficients of another shape or not finite, or for strengths outside their ranges.

    >>> EnvironmentLight.constant().coefficients[0].tolist()
    [1.0, 1.0, 1.0]
    """

    coefficients: NDArray[np.float64]
    """(9, 3): c of each channel, in the order of `lighting.harmonics`; stored as float64."""
    occluded: bool = True
    """Whether the surface hides part of it from itself."""
    fill: float = 0.0
    """Part in [0, 1] of the hidden constant light that comes back: from walls, or through the surface."""
    bounce: float = 0.0
    """Albedo of the surface that throws light onto itself; 0 or more."""

    def __post_init__(self) -> None:
        given = np.array(self.coefficients, np.float64)
        if given.shape != (9, 3):
            raise ValueError(f"coefficients have shape {given.shape}, expected (9, 3): harmonics by channels")
        if not np.isfinite(given).all():
            raise ValueError("coefficients of an environment must be finite")
        if not 0 <= self.fill <= 1:
            raise ValueError(f"fill is {self.fill}, expected a part from 0 to 1 of what is hidden")
        if not 0 <= self.bounce < np.inf:
            raise ValueError(f"bounce is {self.bounce}, expected a finite number, 0 or more")
        object.__setattr__(self, "coefficients", given)

    @classmethod
    def constant(cls) -> EnvironmentLight:
        """Return white light of 1 from everywhere that nothing hides: the paper's ambient light."""
        coefficients = np.zeros((9, 3))
        coefficients[0] = 1.0
        return cls(coefficients, occluded=False)
