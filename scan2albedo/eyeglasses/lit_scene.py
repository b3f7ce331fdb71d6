"""Colours of a scene under distant lights, with shadows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scan2albedo.eyeglasses.environment_lights import DistantLights
from scan2albedo.eyeglasses.inserted_lenses import InsertedLens
from scan2albedo.eyeglasses.lens_scene import LensScene, Surface
from scan2albedo.eyeglasses.lens_shading import environment_radiance
from scan2albedo.eyeglasses.light_kernel import add_light
from scan2albedo.eyeglasses.scene_rays import SceneRays, SeenColors, StraightColors
from scan2albedo.lighting.shadow_map import ShadowMap

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_MATTE = Surface(np.eye(3), np.array([[0, 1, 2]]))
"""A finish for tints; its mesh is not used."""


class LitScene:
    """A scene under distant lights.

        radiance = sum over lights k of E_k V_k (albedo f_d / pi + specular f_s)

    with visibility V from rays, f_d of Oren and Nayar and f_s of Phong. Lenses take their share of light that
    passes them on its way to a surface, but do not bend it.

    Parameters
    ----------
    scene : LensScene
    lenses : sequence of InsertedLens
    lights : DistantLights
    environment : (H, W, 3) float64, optional
        Seen in mirrors; black otherwise.
    background : (H, W, 3) float64, optional
        Seen past all surfaces; black otherwise.
    offset_mm : float
        Of shadow rays.
    """

    def __init__(
        self,
        scene: LensScene,
        lenses: Sequence[InsertedLens],
        lights: DistantLights,
        *,
        environment: FloatArray | None,
        background: FloatArray | None,
        offset_mm: float,
    ) -> None:
        self._scene, self._offset_mm = scene, offset_mm
        self._dimming = [lens for lens in lenses if not lens.material.clear]
        self._toward = np.asarray(lights.directions)
        self._irradiance = np.asarray(lights.irradiance_linear)
        self._environment, self._background = environment, background

    def straight(self, pixels: FloatArray, rays: SceneRays) -> StraightColors:
        """Return colours of straight rays."""
        return self._colors(rays, self._background)

    def seen(self, rays: SceneRays) -> SeenColors:
        """Return colours of rays behind a lens; all are known."""
        return SeenColors(self._colors(rays, self._background).shaded, np.zeros(len(rays.origins), bool))

    def mirrored(self, rays: SceneRays) -> SeenColors:
        """Return colours of mirrored rays; all are known."""
        return SeenColors(self._colors(rays, self._environment).shaded, np.zeros(len(rays.origins), bool))

    def matte(self, position: FloatArray, normal: FloatArray, albedo: FloatArray) -> FloatArray:
        """Return (N, 3) colours of a matte plate."""
        plate = _Finish(position, normal, normal, np.broadcast_to(albedo, position.shape), _MATTE)
        return self._radiance(plate, ()).bare

    def _colors(self, rays: SceneRays, away: FloatArray | None) -> StraightColors:
        bare = np.zeros((len(rays.origins), 3))
        hit = rays.hits.face >= 0
        if away is not None:
            bare[~hit] = environment_radiance(away, rays.directions[~hit])
        shaded = bare.copy()
        if not hit.any():
            return StraightColors(bare, shaded)
        on = rays.chosen(hit)
        points = self._scene.points(on.origins, on.directions, on.hits)
        albedo = self._scene.albedo(points)
        for number, surface in enumerate(self._scene.surfaces):
            own = points.surface == number
            finish = _Finish(
                points.position[own], points.normal[own], points.toward_viewer[own], albedo[own], surface
            )
            colors, place = self._radiance(finish, self._dimming), np.flatnonzero(hit)[own]
            bare[place], shaded[place] = colors.bare, colors.shaded
        return StraightColors(bare, shaded)

    def _radiance(self, points: _Finish, dimming: Sequence[InsertedLens]) -> StraightColors:
        """Return radiances (N, 3) without and with the shadows of lenses."""
        surface = points.surface
        map_ = ShadowMap(self._scene.caster, points.position, points.normal, self._offset_mm)
        diffuse, highlight = np.zeros((2, len(points.position)))
        bare, lost = np.zeros((2, len(points.position), 3))
        for toward, irradiance in zip(self._toward, self._irradiance, strict=True):
            visible = map_.visible(toward)
            add_light(
                points.normal,
                points.toward_viewer,
                points.albedo,
                visible,
                toward,
                irradiance,
                surface.roughness_rad,
                surface.specular,
                surface.shininess,
                diffuse,
                highlight,
                bare,
            )
            if dimming:
                lit = np.flatnonzero(visible)
                behind, kept = _through_lenses(dimming, points.position[lit], toward)
                at = lit[behind]
                matte = points.albedo[at] / np.pi * diffuse[at, None]
                lost[at] += irradiance * (1 - kept) * (matte + surface.specular * highlight[at, None])
        return StraightColors(bare, bare - lost)


@dataclass(frozen=True)
class _Finish:
    """Points of one surface: (N, 3) position, normal, direction to the viewer, albedo."""

    position: FloatArray
    normal: FloatArray
    toward_viewer: FloatArray
    albedo: FloatArray
    surface: Surface


def _through_lenses(
    lenses: Sequence[InsertedLens], position: FloatArray, toward: FloatArray
) -> tuple[IntArray, FloatArray]:
    """Return which points (M,) get a light through lenses, and the share (M, 3) that passes them."""
    hidden = np.stack([lens.caster.occluded(position, toward) for lens in lenses])
    behind = np.flatnonzero(hidden.any(0))
    kept = np.ones((len(behind), 3))
    for lens, hides in zip(lenses, hidden[:, behind], strict=True):
        kept[hides] *= lens.material.transmission
    return behind, kept
