"""`LightingModel`: light of everyday places as a mean and directions of change."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from scan2albedo.core.arrays import ArrayLike, FloatArray, checked_array
from scan2albedo.errors import ReflectanceError
from scan2albedo.io.npz import read_npz
from scan2albedo.reflectance.environment_shading import HARMONICS
from scan2albedo.reflectance.vertex_reflectance import checked_coefficients
from scan2albedo.statistics.linear_model import LinearModel, principal_directions

LIGHTING_FILE = Path(__file__).parent / "data" / "everyday_light.npz"


@dataclass(frozen=True, eq=False)
class LightingModel(LinearModel):
    """Light L = scale_rgb * (mean + sum g_i basis_i) of everyday places, with g of unit variance.

    Every map is divided by its mean radiance in each channel, so that scale_rgb is that mean radiance and the
    directions describe only how light is distributed: `mean` is (81, 3) coefficients of harmonics, sqrt(4 pi)
    first, `basis` (N, 81, 3) with 0 first. Use it as a prior for fits, not as a source of light: lamps are
    rare and strong, and normally distributed coefficients give places with negative light.
    """

    error = ReflectanceError

    @staticmethod
    @cache
    def default() -> LightingModel:
        """Return the model of 600 skies, rooms and studios that tools/build/lighting_model.py makes."""
        what, advice = "lighting model", "install the package anew"
        parts = read_npz(LIGHTING_FILE, ("mean", "basis"), what=what, advice=advice, error=ReflectanceError)
        return LightingModel(**parts)

    @classmethod
    def from_coefficients(cls, lights: ArrayLike, *, components: int = 80) -> LightingModel:
        """Learn from lights (K, 81, 3); `ValueError` for other shapes, `ReflectanceError` for dark ones."""
        samples = checked_array(lights, ("K", HARMONICS, 3), "lights")
        if len(samples) == 0:
            raise ValueError("there are no lights to learn from")
        bad = ~(np.isfinite(samples).all((1, 2)) & (samples[:, 0] > 0).all(1))
        if bad.any():
            raise ReflectanceError(f"light {np.flatnonzero(bad)[0]} has NaN or a dark channel; leave it out")
        spread = samples * (np.sqrt(4 * np.pi) / samples[:, :1])  # to a mean radiance of 1
        off = spread - spread.mean(0)
        off[:, 0] = 0.0
        basis, _ = principal_directions(off, components, size=np.sum(spread**2))
        return cls(spread.mean(0), basis)

    def light(self, coefficients: ArrayLike, *, scale_rgb: ArrayLike = (1.0, 1.0, 1.0)) -> FloatArray:
        """Return coefficients (81, 3) of light with mean radiance `scale_rgb` (3,).

        Raises `ValueError` for another shape, `ReflectanceError` for numbers that are not finite.
        """
        return checked_coefficients(scale_rgb, (3,), "scale_rgb") * self.at(coefficients)
