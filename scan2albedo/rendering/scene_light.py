"""Light of a scene, and what each point of a surface that shadows itself gets of it."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from scan2albedo.core import EnvironmentLight, PointLight
from scan2albedo.core.arrays import ArrayLike, FloatArray
from scan2albedo.lighting.environment import DistantLights
from scan2albedo.lighting.environment_light import environment_light_on
from scan2albedo.lighting.shading import Reflectance, lamp_factors
from scan2albedo.lighting.shadow_map import ShadowMap


@dataclass(frozen=True)
class SceneLight:
    """Lamps, the distant lights that stand for an environment map, light without direction, and soft light.

    A cell of the sphere over which the map's radiance L integrates to w gives a facing surface the irradiance
    w. A matte white one then shines with w / pi, which is the lamp's intensity. Under L = 1 from everywhere a
    matte surface that nothing hides shows its albedo, as under `ambient` light 1. `soft` is an environment of
    low frequency.
    """

    lamps: Sequence[PointLight]
    distant: DistantLights | None = None
    ambient: float = 0.0
    soft: EnvironmentLight | None = None

    @property
    def casts(self) -> bool:
        """Whether any of it can be hidden by the surface."""
        return bool(self.lamps) or self.distant is not None or (self.soft is not None and self.soft.occluded)


def each_lamp(
    shadows: ShadowMap, light: SceneLight, reflectance: Reflectance, view: ArrayLike
) -> Iterator[tuple[FloatArray, FloatArray, FloatArray]]:
    """Yield direction, colour (3,) and `lamp_factors` (2, N) on the points of `shadows` of each that shines.

    The colour is that of a matte white surface at the origin that faces the lamp. `view`, (3,) or (N, 3),
    unit, points toward the viewer.
    """
    toward_viewer = np.ascontiguousarray(np.atleast_2d(np.asarray(view, float)))
    lamps = [
        (x.direction, x.distance_mm, x.radius_deg, x.intensity * np.array(x.color_linear))
        for x in light.lamps
    ]
    if light.distant is not None:
        colors = np.asarray(light.distant.irradiance_linear) / np.pi
        places = np.asarray(light.distant.directions)
        lamps += [(toward, math.inf, 0.0, color) for toward, color in zip(places, colors, strict=True)]
    for direction, distance, radius_deg, color in lamps:
        if color.any():
            # A lamp of some size is a disc of 96 points: fewer show as steps in a shadow's edge.
            visible = shadows.reached(direction, distance, radius_deg, 96)
            surface = shadows.position, shadows.normal, visible
            row = np.array([[*direction, 1 / distance, 1.0]])
            yield (
                direction,
                color,
                lamp_factors(*surface, row, toward_viewer, reflectance)[:, 0],
            )


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
    for _, color, (facing, mirrored) in each_lamp(shadows, light, reflectance, view):
        diffuse += facing[:, None] * color
        if reflectance.specular_strength > 0:
            specular += mirrored[:, None] * color
    if light.soft is not None:
        diffuse = environment_light_on(light.soft, shadows, diffuse)
    scale = 1.0 if specular_scale is None else specular_scale[:, None]
    return diffuse + light.ambient, reflectance.specular_strength * scale * specular


@dataclass(frozen=True)
class LitSurface:
    """The points of `shadows` with all that light does not change, for many lights one after the other.

    `view` (N, 3), unit, points toward the viewer, `albedo` is (N, 3); `specular_scale` as in `shade`.
    """

    shadows: ShadowMap
    reflectance: Reflectance
    view: FloatArray
    albedo: FloatArray
    specular_scale: FloatArray | None = None

    def radiance(self, light: SceneLight) -> FloatArray:
        """Return (N, 3) what goes from each point toward the viewer."""
        diffuse, specular = shade(self.shadows, light, self.reflectance, self.view, self.specular_scale)
        return self.albedo * diffuse + specular
