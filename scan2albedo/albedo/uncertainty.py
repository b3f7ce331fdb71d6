"""How sure the light is, and what that does to the albedo."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scan2albedo.albedo.posterior import NOISE, TEMPER, Point
from scan2albedo.core import PointLight
from scan2albedo.core.arrays import BoolArray, Float32Array, FloatArray, NDArray, rms

_NOT_SKIN = 0.2
"""Relative error of what is not skin, whose shape and reflectance are least known: .68 of the texels of
path-traced faces err by less, with the light's error and the `NOISE` of everything."""


@dataclass(frozen=True)
class Alternative:
    """Other lights that explain the image nearly as well: a second minimum of the objective."""

    lights: tuple[PointLight, ...]
    """In place of those that were found."""
    excess: float
    """Log odds against them."""


@dataclass(frozen=True)
class LightUncertainty:
    """Standard deviations at the optimum, in the order of `AlbedoEstimate.lights`.

    They hold as far as the model of the light does: a surface that is wrong, or a lamp of another kind, is
    not part of them.
    """

    direction_rad: tuple[float, ...]
    """Of each light's direction, root mean square over its two coordinates."""
    intensity: tuple[float, ...]
    """Of each intensity relative to ambient, as a part of it."""
    albedo: float
    """Root mean square over the surface of the albedo's relative deviation, best scale removed."""
    alternatives: tuple[Alternative, ...] = ()
    """Best first; empty where the objective has one minimum only."""

    @property
    def ambiguous(self) -> bool:
        """Whether other lights explain the image nearly as well."""
        return bool(self.alternatives)

    def figures(self) -> dict[str, object]:
        """Return the figures for result.json."""
        others = []
        for other in self.alternatives:
            angles = ((light.azimuth_rad, light.elevation_rad) for light in other.lights)
            lights_deg = [[round(math.degrees(angle), 2) for angle in pair] for pair in angles]
            others.append({"lights_deg": lights_deg, "excess": round(other.excess, 5)})
        return {
            "direction_deviation_deg": [round(math.degrees(d), 4) for d in self.direction_rad],
            "intensity_deviation": [round(d, 5) for d in self.intensity],
            "albedo_deviation": round(self.albedo, 6),
            "alternatives": others,
        }


def expected_error(
    noise: FloatArray, deviation: FloatArray | None, mask: BoolArray, skin: NDArray | None = None
) -> Float32Array:
    """Return (H, W) the relative error that two texels in three stay below, in [0, 1]; 0 outside the mask.

    `noise` (H, W) is the relative standard deviation of the noise that is left, 1 where nothing was measured,
    `deviation` (H, W) that of the albedo which follows from the light's uncertainty, where it is known.
    `skin` (H, W) says how surely a texel is skin, everywhere when None.
    """
    squares = noise**2 + NOISE**2
    if deviation is not None:
        squares += deviation**2 / TEMPER
    if skin is not None:
        squares += (_NOT_SKIN * (1 - skin)) ** 2
    said = np.where(noise >= 1, 1.0, np.minimum(np.sqrt(squares), 1.0))
    return np.where(mask, said, 0.0).astype(np.float32)


def light_uncertainty(point: Point, others: Sequence[Alternative] = ()) -> LightUncertainty:
    """Return how sure the light of a point is."""
    variance = np.maximum(np.diag(point.covariance()), 0.0)
    order = np.argsort(-point.solution().hypothesis.rows[:, 4], kind="stable")
    direction = tuple(float(np.sqrt(variance[3 * k : 3 * k + 2].mean())) for k in order)
    intensity = tuple(float(np.sqrt(variance[3 * k + 2])) for k in order)
    cells = point.light_deviation()
    return LightUncertainty(direction, intensity, rms(cells), tuple(others))
