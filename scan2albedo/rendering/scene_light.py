"""Light of a scene, and what each point of a surface that shadows itself gets of it."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core.arrays import FloatArray
from scan2albedo.core.lights import EnvironmentLight, PointLight
from scan2albedo.lighting.environment import DistantLights
from scan2albedo.lighting.environment_light import environment_light_on
from scan2albedo.lighting.shading import Reflectance, lamp_factors
from scan2albedo.lighting.shadow_map import ShadowMap


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
    def from_lamps(
        cls,
        lights: Sequence[PointLight],
        distant: DistantLights | None = None,
        *,
        ambient: float = 0.0,
        soft: EnvironmentLight | None = None,
    ) -> Self:
        """Return lamps and the distant lights that stand for an environment map.

        A cell of the sphere over which the map's radiance L integrates to w gives a facing surface the
        irradiance w. A matte white one then shines with w / pi, which is the lamp's intensity. Under L = 1
        from everywhere a matte surface that nothing hides shows its albedo, as under ambient light 1.
        """
        directions = [light.direction for light in lights]
        intensity = [light.intensity * np.array(light.color_linear) for light in lights]
        if distant is not None:
            directions += list(np.asarray(distant.directions))
            intensity += list(np.asarray(distant.irradiance_linear) / np.pi)
        toward, strength = (np.reshape(rows, (-1, 3)).astype(np.float64) for rows in (directions, intensity))
        distances, radii = np.full(len(toward), math.inf), np.zeros(len(toward))
        distances[: len(lights)] = [light.distance_mm for light in lights]
        radii[: len(lights)] = [light.radius_deg for light in lights]
        return cls(toward, distances, radii, strength, np.full(3, float(ambient)), soft)

    @property
    def casts(self) -> bool:
        """Whether any of it can be hidden by the surface."""
        return len(self.intensity) > 0 or (self.soft is not None and self.soft.occluded)


def each_lamp(
    shadows: ShadowMap, light: SceneLight, reflectance: Reflectance, view: ArrayLike
) -> Iterator[tuple[int, FloatArray]]:
    """Yield the number of each lamp that shines, and `lamp_factors` (2, N) on the points of `shadows`.

    `view`, (3,) or (N, 3), unit, points toward the viewer.
    """
    toward_viewer = np.ascontiguousarray(np.atleast_2d(np.asarray(view, np.float64)))
    for k in np.flatnonzero(light.intensity.any(1)):
        direction, distance = light.directions[k], float(light.distances_mm[k])
        # A lamp of some size is a disc of 96 points: fewer show as steps in a shadow's edge.
        visible = shadows.reached(direction, distance, float(light.radii_deg[k]), 96)
        surface = shadows.position, shadows.normal, visible
        yield int(k), lamp_factors(*surface, direction, 1 / distance, toward_viewer, reflectance)


def shade(
    shadows: ShadowMap,
    light: SceneLight,
    reflectance: Reflectance,
    view: ArrayLike,
    specular_scale: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Return diffuse and specular light (N, 3) on the points of `shadows`: T = A diffuse + specular.

        diffuse = ambient + soft + sum_k V_k E_k f(n, l_k, v),  specular = k_s sum_k V_k E_k phong(n, l_k, v)

    as in `lighting.shading`, with a colour a lamp, in its highlights too, and a viewer a point: `view`, (3,)
    or (N, 3), unit. Both are linear in the lamps. `specular_scale` (N,) multiplies the highlights. A shadow
    ray and a reflectance are computed for each lamp and point that faces it. Soft light brings along what the
    surface throws onto itself of all light.
    """
    diffuse, specular = np.zeros((2, len(shadows.normal), 3))
    for k, (facing, mirrored) in each_lamp(shadows, light, reflectance, view):
        diffuse += facing[:, None] * light.intensity[k]
        if reflectance.specular_strength > 0:
            specular += mirrored[:, None] * light.intensity[k]
    if light.soft is not None:
        diffuse = environment_light_on(light.soft, shadows, diffuse)
    scale = 1.0 if specular_scale is None else specular_scale[:, None]
    return diffuse + light.ambient, reflectance.specular_strength * scale * specular
