"""Soft light in the search: ambient occlusion, an environment in harmonics, one bounce; with derivatives."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from scan2albedo.albedo.light_parameters import LightModel
from scan2albedo.core.arrays import FloatArray
from scan2albedo.lighting.environment_light import Bounce

DARKEST = 0.03
"""Light below this part of the ambient counts as this: harmonics may turn negative, light may not."""


@dataclass(frozen=True)
class SoftTerms:
    """What soft light needs to know of N points: `transfer` (N, 9), `bounce`, the bases of other `PARTS`.

        I = E + rho B(I - E0),   E = E0 + sum_k c_k T_k + lamps,   E0 = T_0 + f (1 - T_0),

    with the shadowed transfer T_k of the harmonics Y_k / Y_0 (T_0 is ambient occlusion), the fill f, and the
    bounce B of light on albedo 1. Bounced ambient light is part of the fill.
    """

    transfer: FloatArray
    bounce: Bounce | None
    others: dict[str, FloatArray] = field(default_factory=dict)

    @cached_property
    def bases(self) -> dict[str, FloatArray]:
        """(N, K) the light of each linear part by its K parameters."""
        return {"environment": self.transfer[:, 1:], **self.others}

    def linear(self, model: LightModel, x: FloatArray) -> FloatArray:
        """Return (N,) the light of the parts that have a basis."""
        light = np.zeros(len(self.transfer))
        for name, basis in self.bases.items():
            if model.has(name):
                light += basis @ model.part(x, name)
        return light

    def add(self, model: LightModel, x: FloatArray, light: FloatArray, slopes: FloatArray) -> None:
        """Turn `light` (N,), lamps under constant ambient light of 1, into I; `slopes` (N, P) follow."""
        fill, albedo, _ = model.soft(x)
        direct = light - 1 + self.linear(model, x)
        for name, basis in self.bases.items():
            if model.has(name):
                slopes[:, model.slices[name]] = basis
        received = np.zeros_like(light)
        if model.has("bounce"):
            at = model.slices["bounce"].start
            slopes[:, at] = direct
            if self.bounce is not None:
                bounced = self.bounce(slopes)
                received = bounced[:, at].copy()
                slopes += albedo * bounced
            slopes[:, at] = received
        if model.has("occlusion"):
            slopes[:, model.slices["occlusion"].start] = 1 - self.transfer[:, 0]
        light[:] = fill + (1 - fill) * self.transfer[:, 0] + direct + albedo * received
        dark = light < DARKEST
        light[dark] = DARKEST
        slopes[dark] = 0
