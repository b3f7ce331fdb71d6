"""Where colours come from: surfaces under distant lights, with shadows, or a photograph of the scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from scipy.ndimage import binary_dilation
from scipy.spatial import cKDTree

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.eyeglasses.lenses.inserted_lenses import InsertedLens
from scan2albedo.eyeglasses.lenses.scenes import LensScene, SceneRays, radiance_at
from scan2albedo.geometry.pinhole import camera_centers, pixel_directions, pixel_grid, project
from scan2albedo.lighting.environment import DistantLights
from scan2albedo.lighting.shading import Reflectance
from scan2albedo.lighting.shadow_map import ShadowMap
from scan2albedo.rendering.scene_light import SceneLight, each_lamp

_MIXED, _AWAY, _FRAME = -2, -1, 0
"""Labels of pixels: a fringe of nobody's, the background, then numbers of surfaces, the frame's first."""
_LEAST_SHARE = 0.2
"""Share of a bilinear sample that must lie on the wanted surface."""
_SAME_POINT = 3e-4
"""Distance between a point and what the camera sees in its direction, as a part of the scene's size, up to
which they are the same: embree's float32 picks a neighbouring face at times."""


@dataclass(frozen=True)
class RayColors:
    """Linear colours of N rays."""

    bare: FloatArray
    """(N, 3) without any lenses in the scene."""
    shaded: FloatArray
    """(N, 3) with the light that lenses keep from the surfaces taken off."""
    unknown: BoolArray
    """(N,) True where the colour is a guess."""

    @classmethod
    def known(cls, linear: FloatArray, unknown: BoolArray | None = None) -> RayColors:
        """Return colours that lenses do not change."""
        return cls(linear, linear, np.zeros(len(linear), bool) if unknown is None else unknown)


class SceneColors(Protocol):
    """A source of colours: a lit scene, or a photograph of one."""

    def straight(self, pixels: FloatArray, rays: SceneRays) -> RayColors:
        """Return the colours of straight rays through pixels (N, 2)."""

    def seen(self, rays: SceneRays) -> RayColors:
        """Return those of rays behind a lens."""

    def mirrored(self, rays: SceneRays) -> RayColors:
        """Return those of rays that a lens mirrors."""

    def matte(self, position: FloatArray, normal: FloatArray, albedo: FloatArray) -> FloatArray:
        """Return (N, 3) colours of a matte plate (albedo (3,)) at points of a lens."""


class LitScene:
    """A scene under distant lights, before the environment (H, W, 3) that rays see which miss all surfaces.

        radiance = sum over lights k of E_k V_k (albedo f_d / pi + specular f_s)

    with visibility V from rays, f_d of Oren and Nayar and f_s of Phong. Lenses take their share of light that
    passes them on its way to a surface, but do not bend it.
    """

    def __init__(
        self,
        scene: LensScene,
        lenses: Sequence[InsertedLens],
        lights: DistantLights,
        environment: FloatArray | None,
    ) -> None:
        self._scene, self._environment = scene, environment
        self._light = SceneLight.from_lamps((), lights)
        self._dimming = [lens for lens in lenses if not lens.material.clear]

    def straight(self, pixels: FloatArray, rays: SceneRays) -> RayColors:
        """Return what rays see, straight, bent or mirrored."""
        return self.seen(rays)

    def seen(self, rays: SceneRays) -> RayColors:
        """Return what rays see, straight, bent or mirrored."""
        surface = np.where(rays.hits.face >= 0, self._scene.surface_of_face[rays.hits.face], -1)
        bare, shaded = np.empty((2, len(surface), 3))
        past = surface < 0
        bare[past] = shaded[past] = radiance_at(self._environment, rays.directions[past])
        for number in np.unique(surface[~past]):
            finish, own = self._scene.surfaces[number], surface == number
            # The highlight of a lamp counts by its irradiance, which is pi times its intensity.
            skin = Reflectance("oren-nayar", finish.roughness_rad, np.pi * finish.specular, finish.shininess)
            on = rays.chosen(own)
            bare[own], shaded[own] = self._lit(
                on.ends, self._scene.normals(on), -on.directions, self._scene.albedo(on), skin, self._dimming
            )
        return RayColors(bare, shaded, np.zeros(len(surface), bool))

    mirrored = seen

    def matte(self, position: FloatArray, normal: FloatArray, albedo: FloatArray) -> FloatArray:
        """Return (N, 3) colours of a matte plate, whose own lens casts no shadow."""
        return self._lit(position, normal, normal, albedo, Reflectance("lambert"), ())[0]

    def _lit(
        self,
        position: FloatArray,
        normal: FloatArray,
        view: FloatArray,
        albedo: FloatArray,
        reflectance: Reflectance,
        dimming: Sequence[InsertedLens],
    ) -> tuple[FloatArray, FloatArray]:
        """Return (N, 3) radiance without lenses, and with what those that dim light take of it."""
        shadows, strength = ShadowMap(self._scene.caster, position, normal), reflectance.specular_strength
        diffuse, highlight, lost, lost_highlight = np.zeros((4, len(position), 3))
        near = []
        for lens in dimming:
            # Only rays that pass a ball around the lens are shot; float32 may reach a little farther.
            center = (lens.vertices.min(0) + lens.vertices.max(0)) / 2
            reach = 1 + float(np.linalg.norm(lens.vertices - center, axis=1).max())
            near.append((lens, lens.caster.to_local(position), center - position, reach))
        for k, factors in each_lamp(shadows, self._light, reflectance, view):
            toward, intensity = self._light.directions[k], self._light.intensity[k]
            diffuse += factors.diffuse[:, None] * intensity
            highlight += factors.highlight[:, None] * intensity
            if not near:
                continue
            passed = np.ones((len(position), 3))
            for lens, local, offset, reach in near:
                along = offset @ toward
                beside = np.einsum("nc,nc->n", offset, offset) - along**2
                ray = np.flatnonzero((factors.diffuse > 0) & (along >= -reach) & (beside <= reach**2))
                passed[ray[lens.caster.occluded_local(local[ray], toward)]] *= lens.material.transmission
            lost += factors.diffuse[:, None] * intensity * (1 - passed)
            lost_highlight += factors.highlight[:, None] * intensity * (1 - passed)
        bare = albedo * diffuse + strength * highlight
        return bare, bare - (albedo * lost + strength * lost_highlight)


class PhotographedScene:
    """A linear photograph (H, W, 3) as the source of colours: points are looked up where the camera saw them.

    The scene is as photographed, the frame without lenses included. Points that were not seen take the colour
    of the nearest one of their surface among the pixels of `region`, or their albedo where there is none.
    Nothing is taken from `fringe_px` pixels around the frame and of the background around surfaces. Mirrors
    show the environment (H, W, 3) where they show no surface.
    """

    def __init__(
        self,
        scene: LensScene,
        picture: FloatArray,
        camera: FloatArray,
        *,
        fringe_px: int,
        region: tuple[slice, slice],
        environment: FloatArray | None = None,
    ) -> None:
        self._scene, self._picture, self._camera = scene, picture, camera
        self._center = camera_centers(camera[None])[0]
        self._fringe_px, self._region, self._environment = fringe_px, region, environment
        self._shown: dict[int, tuple[cKDTree, FloatArray]] = {}

    def straight(self, pixels: FloatArray, rays: SceneRays) -> RayColors:
        """Return the photograph's own pixels."""
        last = np.array(self._picture.shape[1::-1]) - 1
        column, row = np.clip(np.round(pixels).astype(np.int64), 0, last).T
        return RayColors.known(self._picture[row, column])

    def seen(self, rays: SceneRays) -> RayColors:
        """Return what the photograph shows at the ends of rays, and where it does not."""
        linear, unknown = np.zeros((len(rays.origins), 3)), np.zeros(len(rays.origins), bool)
        hit = rays.hits.face >= 0
        if hit.any():
            linear[hit], unknown[hit] = self._surface_colors(rays.chosen(hit))
        if not hit.all():
            # A background far away; where the photograph shows none there, that which is seen as near as
            # possible to the lens itself: surfaces may hide a ray's own direction over long stretches.
            past = rays.chosen(~hit)
            pixels, _ = project(self._camera, self._center + past.directions)
            colors, known = self._sample(pixels, np.full(len(pixels), _AWAY))
            shown = np.argwhere(self._labels == _AWAY)
            if len(shown) and not known.all():
                at, _ = project(self._camera, past.origins[~known])
                row, column = shown[cKDTree(shown).query(at[:, ::-1])[1]].T
                colors[~known] = self._picture[row, column]
            linear[~hit], unknown[~hit] = colors, ~known
        return RayColors.known(linear, unknown)

    def mirrored(self, rays: SceneRays) -> RayColors:
        """Return what mirrors show: points of the photograph, or the environment."""
        hit = rays.hits.face >= 0
        linear, unknown = radiance_at(self._environment, rays.directions), np.zeros(len(hit), bool)
        on_surface = self.seen(rays.chosen(hit))
        linear[hit], unknown[hit] = on_surface.bare, on_surface.unknown
        return RayColors.known(linear, unknown)

    def matte(self, position: FloatArray, normal: FloatArray, albedo: FloatArray) -> FloatArray:
        """Return the tint as it is: its light is the photograph's."""
        return np.broadcast_to(albedo, position.shape)

    @cached_property
    def _labels(self) -> IntArray:
        """(H, W) what each pixel shows."""
        shape = self._picture.shape[:2]
        face = self._scene.rays(self._center, pixel_directions(self._camera, pixel_grid(shape))).hits.face
        label = np.where(face >= 0, self._scene.surface_of_face[face], _AWAY).reshape(shape)
        if self._fringe_px:
            frame, away = label == _FRAME, label == _AWAY
            for kind, others in ((frame, ~frame), (~away, away)):
                label[binary_dilation(kind, np.ones((3, 3)), iterations=self._fringe_px) & others] = _MIXED
        return label

    def _surface_colors(self, rays: SceneRays) -> tuple[FloatArray, BoolArray]:
        """Return colours (N, 3) where rays that all hit end, and where these are guesses."""
        position, surface = rays.ends, self._scene.surface_of_face[rays.hits.face]
        linear, sampled = self._sample(project(self._camera, position)[0], surface)
        distance = np.linalg.norm(position - self._center, axis=1)
        first = self._scene.rays(self._center, (position - self._center) / distance[:, None]).hits.distance
        known = sampled & (first >= distance - _SAME_POINT * self._scene.caster.size)
        for number in np.unique(surface[~known]).tolist():
            lost = ~known & (surface == number)
            if number not in self._shown:
                own = np.zeros(self._labels.shape, bool)
                own[self._region] = self._labels[self._region] == number
                row, column = np.nonzero(own)
                shown = self._scene.rays(
                    self._center, pixel_directions(self._camera, np.stack([column, row], 1))
                )
                on = np.flatnonzero(shown.hits.face >= 0)
                self._shown[number] = cKDTree(shown.chosen(on).ends), self._picture[row[on], column[on]]
            tree, colors = self._shown[number]
            if len(colors):
                linear[lost] = colors[tree.query(position[lost])[1]]
            else:
                linear[lost] = self._scene.albedo(rays.chosen(lost))
        return linear, ~known

    def _sample(self, pixels: FloatArray, labels: IntArray) -> tuple[FloatArray, BoolArray]:
        """Return bilinear colours (N, 3) from pixels of the given labels, and where there are any."""
        rows, columns = self._picture.shape[:2]
        at = np.where(np.isfinite(pixels), pixels, -1.0)
        inside = np.asarray(((at >= 0) & (at <= [columns - 1, rows - 1])).all(1))
        at = np.clip(at, 0, [columns - 1, rows - 1])
        corner = np.floor(at).astype(np.int64)
        total, share = np.zeros((len(at), 3)), np.zeros(len(at))
        for right, below in ((0, 0), (1, 0), (0, 1), (1, 1)):
            column = np.minimum(corner[:, 0] + right, columns - 1)
            row = np.minimum(corner[:, 1] + below, rows - 1)
            part = np.abs(1 - right - (at - corner)[:, 0]) * np.abs(1 - below - (at - corner)[:, 1])
            part = part * (self._labels[row, column] == labels)
            total += part[:, None] * self._picture[row, column]
            share += part
        return total / np.where(share > 0, share, 1.0)[:, None], inside & (share >= _LEAST_SHARE)
