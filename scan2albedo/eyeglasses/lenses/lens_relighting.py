"""Pictures of lenses in another light: what rays found stays, only weights of lights change."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.lenses.environment_lights import DistantLights, MapCells, map_cells
from scan2albedo.eyeglasses.lenses.lens_rendering import PixelRegion
from scan2albedo.eyeglasses.lenses.scene_rays import Illumination, RayColors
from scan2albedo.eyeglasses.lenses.traced_rays import TracedPicture

FloatArray = NDArray[np.float64]

_NEGLIGIBLE = 1e-12
"""Part of all light below which a light may be left out."""


def checked_image(name: str, values: ArrayLike) -> FloatArray:
    """Return an image (H, W, 3) of finite numbers.

    Raises
    ------
    EyeglassesError
        When numbers are not finite.
    ValueError
        When the shape is another.
    """
    image = np.asarray(values, np.float64)
    if image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise ValueError(f"{name} must have shape (H, W, 3), got {image.shape}")
    if not np.isfinite(image).all():
        raise EyeglassesError(f"{name} holds numbers that are not finite; repair it first")
    return image


def without_dark(lights: DistantLights) -> DistantLights:
    """Return the lights that matter, at least one."""
    strength = np.abs(np.asarray(lights.irradiance_linear)).max(1)
    bright = strength > _NEGLIGIBLE * strength.sum()
    bright[strength.argmax()] = True
    return DistantLights(np.asarray(lights.directions)[bright], np.asarray(lights.irradiance_linear)[bright])


@dataclass(frozen=True)
class LensRelighting:
    """A picture's rays and where they belong."""

    traced: TracedPicture
    window: PixelRegion
    empty: FloatArray
    """(H, W, 3) the picture outside the window."""
    toward: FloatArray
    """(K, 3) unit directions to the lights; none for a photograph."""
    _cells: dict[tuple[int, ...], MapCells] = field(default_factory=dict, repr=False)

    def light(self, environment: FloatArray | None, irradiance: FloatArray | None) -> Illumination:
        """Return the light of an environment, or of the lights' irradiance before an environment."""
        if irradiance is not None and irradiance.shape not in ((len(self.toward),), self.toward.shape):
            raise ValueError(
                f"irradiance_linear must be ({len(self.toward)},) or ({len(self.toward)}, 3), one a light, "
                f"got {irradiance.shape}"
            )
        if irradiance is not None and not np.isfinite(irradiance).all():
            raise ValueError("irradiance_linear must be finite")
        if irradiance is not None:
            per_channel = irradiance if irradiance.ndim == 2 else np.repeat(irradiance[:, None], 3, 1)
            return Illumination(np.ascontiguousarray(per_channel), environment)
        if environment is None:
            raise ValueError("give environment_linear, irradiance_linear or both")
        if len(self.toward) == 0:
            return Illumination(np.zeros((0, 3)), environment)
        size = environment.shape[:2]
        if size not in self._cells:
            self._cells[size] = map_cells(self.toward, size)
        return Illumination(self._cells[size].weights(environment), environment)

    def colors(self, light: Illumination) -> RayColors:
        """Return the pictures (H, W, 3) in a light, without lenses and with them."""
        colors = self.traced.colors(light)
        return RayColors(
            pasted(self.empty, self.window, colors.bare), pasted(self.empty, self.window, colors.shaded)
        )


def pasted(picture: NDArray[Any], window: PixelRegion, values: NDArray[Any]) -> NDArray[Any]:
    """Return a copy of a picture with the window's pixels (N, ...) in it."""
    if window.shape == picture.shape[:2]:
        return values.reshape(picture.shape).astype(picture.dtype, copy=False)
    result = picture.copy()
    result[window.slices] = values.reshape(*window.shape, *picture.shape[2:])
    return result
