"""Soft light in the search: ambient occlusion, an environment in harmonics, one bounce; with derivatives."""

from dataclasses import dataclass

import numpy as np

from scan2albedo.albedo.light_parameters import HARMONICS, LightModel
from scan2albedo.core.arrays import FloatArray
from scan2albedo.lighting.environment_light import Bounce

DARKEST = 0.03
"""Light below this part of the ambient counts as this: harmonics may turn negative, light may not."""


@dataclass(frozen=True)
class SoftTerms:
    """What soft light needs to know of N points: their `transfer` (N, 9), and their `bounce`.

        I = E + rho B(I - E0),   E = E0 + sum_k c_k T_k + lamps,   E0 = T_0 + f (1 - T_0),

    with the shadowed transfer T_k of the harmonics Y_k / Y_0 (T_0 is ambient occlusion), the fill f, and the
    bounce B of light on albedo 1. Bounced ambient light is part of the fill.
    """

    transfer: FloatArray
    bounce: Bounce | None

    def ambient(self, fill: float) -> FloatArray:
        """Return (N,) E0."""
        return fill + (1 - fill) * self.transfer[:, 0]

    def add(self, model: LightModel, x: FloatArray, light: FloatArray, slopes: FloatArray) -> None:
        """Turn `light` (N,), lamps under constant ambient light of 1, into I; `slopes` (N, P) follow."""
        (fill, albedo, waves), direct = model.soft(x), light - 1
        if model.environment:
            first = model.position_of("environment")
            slopes[:, first : first + HARMONICS] = self.transfer[:, 1:]
            direct = direct + self.transfer[:, 1:] @ waves
        received = np.zeros_like(light)
        if model.bounce:
            at = model.position_of("bounce")
            slopes[:, at] = direct
            if self.bounce is not None:
                bounced = self.bounce(slopes)
                received = bounced[:, at].copy()
                slopes += albedo * bounced
            slopes[:, at] = received
        if model.occlusion:
            slopes[:, model.position_of("occlusion")] = 1 - self.transfer[:, 0]
        light[:] = self.ambient(fill) + direct + albedo * received
        dark = light < DARKEST
        light[dark] = DARKEST
        slopes[dark] = 0
