"""`SceneLight`: ambient light and coloured lamps that together light a face."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core.arrays import FloatArray
from scan2albedo.core.environment_light import EnvironmentLight
from scan2albedo.core.point_light import PointLight
from scan2albedo.lighting.environment import DistantLights
from scan2albedo.lighting.environment_light import environment_light_on
from scan2albedo.lighting.shading import Reflectance, lamp_factors
from scan2albedo.lighting.shadow_map import ShadowMap

_LAMP_POINTS = 96
"""Of the disc that stands for a lamp of some size: fewer show as steps in a shadow's edge."""


@dataclass(frozen=True)
class SceneLight:
    """K lamps and ambient light, each with a strength a channel.

    Unit `directions` (K, 3) point from the model's origin toward the lamps, `distances_mm` (K,) from there,
    inf for distant lamps, and `radii_deg` (K,) are their angular radii. `intensity` (K, 3) is in the unit of
    `PointLight.intensity`: the colour of a matte white surface at the origin that faces the lamp. `ambient`
    (3,) is the colour that light without direction gives a white surface, and `soft` an environment of low
    frequency.
    """

    directions: FloatArray
    distances_mm: FloatArray
    radii_deg: FloatArray
    intensity: FloatArray
    ambient: FloatArray
    soft: EnvironmentLight | None = None

    @classmethod
    def of(
        cls,
        lights: Sequence[PointLight],
        environment: DistantLights | None = None,
        *,
        ambient: float,
        soft: EnvironmentLight | None = None,
    ) -> SceneLight:
        """Return lamps and the distant lights that stand for an environment map.

        A cell of the sphere over which the map's radiance L integrates to w gives a facing surface the
        irradiance w. A matte white one then shines with w / pi, which is the lamp's intensity. Under L = 1
        from everywhere a matte surface that nothing hides shows its albedo, as under ambient light 1.
        """
        directions = [light.direction for light in lights]
        distances = [light.distance_mm for light in lights]
        radii = [light.radius_deg for light in lights]
        intensity = [light.intensity * np.array(light.color_linear) for light in lights]
        if environment is not None:
            toward = np.asarray(environment.directions)
            directions += list(toward)
            distances += [math.inf] * len(toward)
            radii += [0.0] * len(toward)
            intensity += list(np.asarray(environment.irradiance_linear) / np.pi)
        return cls(
            np.reshape(directions, (-1, 3)).astype(np.float64),
            np.array(distances, np.float64),
            np.array(radii, np.float64),
            np.reshape(intensity, (-1, 3)).astype(np.float64),
            np.full(3, float(ambient)),
            soft,
        )

    @property
    def casts(self) -> bool:
        """Whether any of it can be hidden by the surface."""
        return len(self.intensity) > 0 or (self.soft is not None and self.soft.occluded)


@dataclass(frozen=True)
class Shaded:
    """`diffuse` (N, 3) multiplies the albedo; `specular` (N, 3) is added to it."""

    diffuse: FloatArray
    specular: FloatArray


def shade(
    shadows: ShadowMap,
    light: SceneLight,
    reflectance: Reflectance,
    view: ArrayLike,
    specular_scale: FloatArray | None = None,
) -> Shaded:
    """Return the light on the N points of `shadows`: T = A diffuse + specular.

        diffuse = ambient + soft + sum_k V_k E_k f(n, l_k, v),  specular = k_s sum_k V_k E_k phong(n, l_k, v)

    as in `lighting.shading`, with a colour a lamp, in its highlights too, and a viewer a point: `view`, (3,)
    or (N, 3), unit. Both are linear in the lamps. `specular_scale` (N,) multiplies the highlights. A shadow
    ray and a reflectance are computed for each lamp and point that faces it. Soft light brings along what the
    surface throws onto itself of all light.
    """
    position, normal = shadows.position, shadows.normal
    toward_viewer = np.ascontiguousarray(np.atleast_2d(np.asarray(view, np.float64)))
    diffuse, specular = np.zeros((2, len(normal), 3))
    for direction, distance, radius, intensity in zip(
        light.directions, light.distances_mm, light.radii_deg, light.intensity, strict=True
    ):
        if not intensity.any():
            continue
        visible = shadows.reached(direction, float(distance), float(radius), _LAMP_POINTS)
        factors = lamp_factors(position, normal, visible, direction, 1 / distance, toward_viewer, reflectance)
        diffuse += factors.diffuse[:, None] * intensity
        if reflectance.specular_strength > 0:
            specular += factors.highlight[:, None] * intensity
    if light.soft is not None:
        diffuse = environment_light_on(light.soft, shadows, diffuse)
    diffuse += light.ambient
    scale = np.ones(len(normal)) if specular_scale is None else specular_scale
    return Shaded(diffuse, reflectance.specular_strength * scale[:, None] * specular)
