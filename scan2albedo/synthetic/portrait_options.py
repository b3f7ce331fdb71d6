"""How the synthetic camera stands before a person and what it stores."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scan2albedo.synthetic.portrait import stored_values


@dataclass(frozen=True, kw_only=True)
class PortraitOptions:
    """What all pictures of a person have in common.

    Parameters
    ----------
    picture_size : int
        Height and width in pixels.
    reach_mm : float
        Half of what a picture spans at the head.
    distance_mm : float
        Of the camera from the head.
    gamma : float
        Values are light^(1 / gamma).
    noise : float
        Standard deviation of the values, white = 1.
    bits : int or None
        8, 16, or None for values that are neither rounded nor clipped.
    saturated_part : float
        Of all the face's pixels in all pictures, brighter than white.
    hair : bool
        Whether there is hair, which hides and shades the brow and is not in the mesh.
    levels : int
        Of subdivision of the mesh: 1 is 3,663 vertices with the default model, 2 is 14,533.

    Raises
    ------
    ValueError
        When a value is outside its range.
    """

    picture_size: int = 256
    reach_mm: float = 130.0
    distance_mm: float = 1000.0
    gamma: float = 1.2
    noise: float = 0.01
    bits: int | None = 8
    saturated_part: float = 0.002
    hair: bool = True
    levels: int = 1

    def __post_init__(self) -> None:
        self._refuse_below_one("picture_size")
        for name in ("reach_mm", "distance_mm", "gamma"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} is {getattr(self, name)}, expected > 0 and finite")
        self._refuse_negative("noise")
        if not 0 <= self.saturated_part < 1:
            raise ValueError(f"saturated_part is {self.saturated_part}, expected in [0, 1)")
        if self.bits not in (8, 16, None):
            raise ValueError(f"bits is {self.bits}, expected 8, 16 or None")
        if self.levels not in (1, 2, 3):
            raise ValueError(f"levels is {self.levels}, expected 1, 2 or 3")

    def _refuse_below_one(self, *names: str) -> None:
        """Raise ValueError unless these options are 1 or more."""
        for name in names:
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}, expected >= 1")

    def _refuse_negative(self, *names: str) -> None:
        """Raise ValueError unless these options are finite and not negative."""
        for name in names:
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} is {getattr(self, name)}, expected >= 0 and finite")

    def stored(self, linear: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.generic]:
        """Return the values that the camera stores of light (H, W, 3), white = 1, with its noise."""
        return stored_values(linear, gamma=self.gamma, noise=self.noise, bits=self.bits, rng=rng)
