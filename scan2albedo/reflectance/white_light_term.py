"""A penalty on the colour of light."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scan2albedo.reflectance.lighting_model import LightingModel

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class WhiteLightTerm:
    """The penalty w / u^2 sum over lm and j of (L_lm,j - mean over j of L_lm,j)^2.

    Parameters
    ----------
    weight : float
        w.
    unit : float
        u, a fixed radiance, so that exposure does not matter and the term is a square of L.
    lighting : LightingModel
    """

    weight: float
    unit: float
    lighting: LightingModel

    def value(self, light: FloatArray) -> float:
        """Return the penalty on light (81, 3)."""
        return self.weight * float(np.sum(self._off(light) ** 2))

    def normal_equations(self, log_scale: FloatArray, light: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return Gauss-Newton matrix and gradient by the M coefficients of light and log scale_rgb (3,)."""
        count = self.lighting.components
        rows = np.zeros((*light.shape, count + 3))
        rows[:, :, :count] = np.moveaxis(self.lighting.basis, 0, -1) * np.exp(log_scale)[:, None]
        for channel in range(3):
            rows[:, channel, count + channel] = light[:, channel]
        rows = self._off(rows).reshape(light.size, -1)
        return 2 * self.weight * rows.T @ rows, 2 * self.weight * rows.T @ self._off(light).ravel()

    def _off(self, values: FloatArray) -> FloatArray:
        return np.asarray((values - values.mean(1, keepdims=True)) / self.unit)
