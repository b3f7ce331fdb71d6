"""The analytical skin reflectance model: ambient, diffuse and specular light of several point lights."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scan2albedo.core.arrays import FloatArray
from scan2albedo.core.lights import PointLight
from scan2albedo.lighting import kernels

_BRDFS = "lambert", "minnaert", "oren-nayar"


@dataclass(frozen=True)
class Reflectance:
    """How the surface reflects; the albedo is not part of it.

    `brdf` is "oren-nayar", "lambert" or "minnaert"; `roughness` is Oren-Nayar's sigma in radians (0 is
    Lambert) or Minnaert's exponent (1 is Lambert). `specular_strength` is Phong's k_s for a light of
    intensity 1, in the unit of the texture; `exponent` is Phong's m. ValueError for an unknown `brdf`, rough
    Lambert, or a number that is negative or not finite.
    """

    brdf: str = "oren-nayar"
    roughness: float = 0.0
    specular_strength: float = 0.0
    exponent: float = 16.0

    def __post_init__(self) -> None:
        if self.brdf not in _BRDFS:
            raise ValueError(f"brdf is {self.brdf!r}, expected one of {_BRDFS}")
        if self.brdf == "lambert" and self.roughness != 0:
            raise ValueError(f"a Lambertian surface has roughness 0, got {self.roughness}")
        for name in ("roughness", "specular_strength", "exponent"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} is {getattr(self, name)}, expected a finite number, 0 or more")


@dataclass(frozen=True)
class Shading:
    """`light` (N,) = I_a + I_d with I_a = 1, and `specular` (N,) = I_s in the unit of the texture.

    `light_linear` and `specular_linear` (N, 3) are in the lamps' colours; `lamps` (L, N) each lamp's part.
    """

    light: FloatArray
    specular: FloatArray
    light_linear: FloatArray
    specular_linear: FloatArray
    lamps: FloatArray


def light_from_direction(direction: ArrayLike, distance_mm: float, intensity: float) -> PointLight:
    """Return the `PointLight` in `direction` (3,), of any length.

    >>> round(math.degrees(light_from_direction((1, 0, 1), math.inf, 1.0).azimuth_rad))
    45
    """
    x, y, z = np.asarray(direction, np.float64) / np.linalg.norm(direction)
    return PointLight(math.atan2(x, z), math.asin(max(-1.0, min(1.0, y))), distance_mm, float(intensity))


def shade_points(
    position: ArrayLike,
    normal: ArrayLike,
    lights: Sequence[PointLight],
    reflectance: Reflectance,
    *,
    visible: ArrayLike | None = None,
    view_direction: ArrayLike = (0.0, 0.0, 1.0),
    specular_scale: ArrayLike | None = None,
) -> Shading:
    """Evaluate the ASRM: T = A (I_a + I_d) + I_s.

    I_d = sum_k V_k E_k f(n, l_k, v), I_s = k_s sum_k V_k E_k phong(n, l_k, v), I_a = 1, with V the visibility
    and E = intensity (distance/r)^2 (no falloff for a distant light), times the lamp's colour.

    `position` (N, 3) is in mm, `normal` (N, 3) unit. `visible` (L, N) is 0 where a light is hidden; all is
    visible when None. `view_direction` (3,) or (N, 3), of any length, points toward the viewer;
    `specular_scale` (N,) multiplies I_s. ValueError for shapes that do not fit, or what is not finite.

    .. [1] G. Toderici, G. Passalis, T. Theoharis, I. Kakadiaris, "An automated method for human face
       modeling and relighting with application to face recognition", section 3.2.1.
    """
    xyz, unit = np.ascontiguousarray(position, np.float64), np.ascontiguousarray(normal, np.float64)
    count = len(xyz)
    seen = np.ones((len(lights), count), np.uint8) if visible is None else np.asarray(visible)
    scale = np.ones(count) if specular_scale is None else np.asarray(specular_scale, np.float64)
    view = np.asarray(view_direction, np.float64)
    # Compiled loops would read past the end of other arrays, or turn them to NaN.
    given = {"position": xyz, "normal": unit, "visible": seen, "specular_scale": scale}
    shapes = (count, 3), (count, 3), (len(lights), count), (count,)
    for (name, array), shape in zip(given.items(), shapes, strict=True):
        if array.shape != shape:
            raise ValueError(f"{name} has shape {array.shape}, expected {shape}")
    for name in ("position", "normal", "specular_scale"):
        bad = np.argwhere(~np.isfinite(given[name]))
        if len(bad):
            raise ValueError(f"{name} {bad[0, 0]} is not finite ({len(bad)} numbers are not); leave such out")
    if view.shape not in ((3,), (count, 3)) or not np.isfinite(view).all() or not view.any(-1).all():
        raise ValueError(f"view_direction is {view.tolist()}, expected three finite numbers, not all zero")
    colors = None if all(lamp.white for lamp in lights) else np.array([lamp.color_linear for lamp in lights])
    toward = view / np.linalg.norm(view, axis=-1, keepdims=True)
    rows = [(*lamp.direction, 1 / lamp.distance_mm, lamp.intensity) for lamp in lights]
    return shade_rows(xyz, unit, seen, np.reshape(rows, (-1, 5)), toward, reflectance, scale, colors)


def shade_rows(
    position: FloatArray,
    normal: FloatArray,
    visible: NDArray,
    rows: FloatArray,
    view: FloatArray,
    reflectance: Reflectance,
    scale: FloatArray,
    colors: FloatArray | None = None,
) -> Shading:
    """Do as `shade_points` for `rows` (L, 5) of lamps: direction, 1/distance, intensity; nothing is checked.

    `view`, (3,) or (N, 3), is unit; `colors` (L, 3) are the lamps', all white when None.
    """
    count = len(position)
    light, gloss, lamps = np.ones(count), np.zeros(count), np.empty((len(rows), count))
    tint, sheen = np.zeros((2, count, 3))
    for k, (row, seen) in enumerate(zip(rows, visible, strict=True)):
        at = row[:3], row[3], np.atleast_2d(view), reflectance
        lamps[k], highlight = row[4] * lamp_factors(position, normal, seen, *at)
        light += lamps[k]
        gloss += highlight
        if colors is not None:
            tint += lamps[k][:, None] * (colors[k] - 1)
            sheen += highlight[:, None] * (colors[k] - 1)
    strength = reflectance.specular_strength * scale
    whole = strength[:, None] * (gloss[:, None] + sheen)
    return Shading(light, strength * gloss, light[:, None] + tint, whole, lamps)


def lamp_factors(
    position: FloatArray,
    normal: FloatArray,
    visible: NDArray,
    direction: FloatArray,
    nearness: float,
    view: FloatArray,
    reflectance: Reflectance,
) -> FloatArray:
    """Return (2, N) what multiplies a lamp's intensity in light on the albedo, in highlights of k_s = 1."""
    factors = np.empty((2, len(position)))
    kernels.lamp_factors(
        position,
        normal,
        np.ascontiguousarray(visible),
        np.ascontiguousarray(direction),
        float(nearness),
        view,
        reflectance.brdf == "minnaert",
        float(reflectance.roughness),
        float(reflectance.exponent) if reflectance.specular_strength > 0 else -1.0,
        factors[0],
        factors[1],
    )
    return factors
