"""Where colours come from: surfaces under distant lights, with shadows, or a photograph of the scene."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Self

import numpy as np
from scipy.ndimage import binary_dilation
from scipy.spatial import cKDTree

from scan2albedo.core.arrays import ArrayLike, BoolArray, ByteArray, FloatArray, IntArray, dots, norms
from scan2albedo.eyeglasses.lenses.inserted_lenses import InsertedLens
from scan2albedo.eyeglasses.lenses.scenes import LensScene, SceneRays, radiance_at
from scan2albedo.geometry.pinhole import camera_centers, pixel_directions, pixel_grid, project
from scan2albedo.geometry.rasterization import bilinear, within
from scan2albedo.lighting.environment import DistantLights
from scan2albedo.lighting.shading import Reflectance
from scan2albedo.lighting.shadow_map import ShadowMap
from scan2albedo.rendering.scene_light import SceneLight, each_lamp

_MIXED = -2
"""Label of pixels on a fringe, a pixel wide, which may hold some of two surfaces."""
_AWAY = -1
"""Label of the background; others are numbers of surfaces, the frame's is 0."""
_LEAST_SHARE = 0.2
"""Share of a bilinear sample that must lie on the wanted surface."""
_FLAT = 0.2
"""Sine of the angle between a surface and the way to a neighbour, up to which it counts as flat between."""
_SAME_POINT = 3e-4
"""Distance between a point and what the camera sees in its direction, as a part of the scene's size, up to
which they are the same: embree's float32 picks a neighbouring face at times."""


@dataclass(frozen=True)
class RayColors:
    """Linear colours (N, 3) of rays: without lenses, and with the light that they keep off the surfaces.

    `unknown` (N,) is True where the colour is a guess.
    """

    bare: FloatArray
    shaded: FloatArray
    unknown: BoolArray

    @classmethod
    def known(cls, linear: FloatArray, unknown: BoolArray | None = None) -> Self:
        """Return colours that lenses do not change."""
        return cls(linear, linear, np.zeros(len(linear), bool) if unknown is None else unknown)


@dataclass(frozen=True, kw_only=True)
class _PixelShadows(ShadowMap):
    """Shadows of points that `pixels` (N, 2) see; neighbours share them.

    Pixels of even rows and columns shoot rays to all lights, then those of odd ones, then the rest: where the
    surface is flat, points between others shoot rays only to the lights about which these disagree.
    """

    pixels: FloatArray

    @cached_property
    def _stages(self) -> list[tuple[IntArray, IntArray]]:
        """Numbers (M,) of points, first those that ask for themselves, and of the points around (4, M)."""
        own = np.arange(len(self.position))
        cell = np.round(self.pixels).astype(int) + 2
        columns = cell[:, 0].max(initial=0) + 2
        place = cell[:, 1] * columns + cell[:, 0]
        first = np.unique(place, return_index=True)[1]
        known = np.full(place.max(initial=0) + 2 * columns, -1)
        known[place[first]] = first
        odd = (cell % 2).sum(1) * (len(first) == len(own))
        side = np.array([[0, 1, columns + 1], [0, columns, columns - 1]])[:, odd]
        around = known[place + np.concatenate([side, -side])]
        step = self.position[around] - self.position
        rise = np.abs(np.einsum("knc,nc->kn", step, self.normal))
        rise = np.maximum(rise, np.abs(dots(step, self.normal[around])))
        flat = ((around >= 0) & (rise <= _FLAT * norms(step))).all(0)
        alone = ~flat | (around[0] == own)
        stages = [np.flatnonzero(which) for which in (alone, ~alone & (odd == 2), ~alone & (odd != 2))]
        return [(at, around[:, at]) for at in stages]

    @cached_property
    def _alone(self) -> ShadowMap:
        return self._some(self._stages[0][0])

    def visible(self, direction: ArrayLike, distance_mm: float = math.inf) -> ByteArray:
        """Return (N,) uint8, 1 where a light reaches the point."""
        reached = np.zeros(len(self.position), np.uint8)
        reached[self._stages[0][0]] = self._alone.visible(direction, distance_mm)
        for at, around in self._stages[1:]:
            those = reached[around].sum(0)
            reached[at] = those == len(around)
            unsure = at[(those > 0) & (those < len(around))]
            if len(unsure):
                reached[unsure] = self._some(unsure).visible(direction, distance_mm)
        return reached


@dataclass(frozen=True)
class LitScene:
    """A scene under distant lights, before the environment (H, W, 3) that rays see which miss all surfaces.

        radiance = sum over lights k of E_k V_k (albedo f_d / pi + specular f_s)

    with visibility V from rays, f_d of Oren and Nayar and f_s of Phong. Lenses dim light, but do not bend it.
    """

    scene: LensScene
    lenses: Sequence[InsertedLens]
    lights: DistantLights
    environment: FloatArray | None

    def look(self, straight: SceneRays, bent: SceneRays, mirrored: Sequence[SceneRays]) -> list[RayColors]:
        """Return the colours of straight rays, of those behind a lens, and of sets that lenses mirror."""
        return [self.seen(rays) for rays in (straight, bent, *mirrored)]

    def seen(self, rays: SceneRays) -> RayColors:
        """Return what rays see, straight, bent or mirrored."""
        surface = np.where(rays.hits.face >= 0, self.scene.surface_of_face[rays.hits.face], -1)
        bare, shaded = np.empty((2, len(surface), 3))
        past = surface < 0
        dimming = [lens for lens in self.lenses if not lens.material.clear]
        bare[past] = shaded[past] = radiance_at(self.environment, rays.directions[past])
        for number in np.unique(surface[~past]):
            finish, own = self.scene.surfaces[number], surface == number
            # The highlight of a lamp counts by its irradiance, which is pi times its intensity.
            skin = Reflectance("oren-nayar", finish.roughness_rad, np.pi * finish.specular, finish.shininess)
            on, caster = rays.chosen(own), self.scene.caster
            shadows = ShadowMap(caster, on.ends, self.scene.normals(on))
            if on.pixels is not None:
                shadows = _PixelShadows(caster, shadows.position, shadows.normal, pixels=on.pixels)
            albedo = self.scene.albedo(on)
            bare[own], shaded[own] = self._shade(shadows, -on.directions, albedo, skin, dimming)
        return RayColors(bare, shaded, np.zeros(len(surface), bool))

    def matte(self, position: FloatArray, normal: FloatArray, albedo: FloatArray) -> FloatArray:
        """Return (N, 3) colours of a matte plate, whose own lens casts no shadow."""
        shadows = ShadowMap(self.scene.caster, position, normal)
        return self._shade(shadows, normal, albedo, Reflectance("lambert"), ())[0]

    def _shade(
        self,
        shadows: ShadowMap,
        view: FloatArray,
        albedo: FloatArray,
        reflectance: Reflectance,
        dimming: Sequence[InsertedLens],
    ) -> FloatArray:
        """Return (2, N, 3) radiance without lenses, and with what those that dim light take of it."""
        position, strength, near = shadows.position, reflectance.specular_strength, []
        light = SceneLight((), self.lights)
        unfiltered, lost = np.zeros((2, len(position), 3))
        for lens in dimming:
            # Only rays that pass a ball around the lens are shot; float32 may reach a little farther.
            center = (lens.vertices.min(0) + lens.vertices.max(0)) / 2
            reach = 1 + norms(lens.vertices - center).max()
            way = center - position
            near.append((lens, lens.caster.to_local(position), way, (way**2).sum(1) - reach**2, reach))
        for toward, intensity, (facing, mirrored) in each_lamp(shadows, light, reflectance, view):
            radiance = albedo * facing[:, None]
            if strength > 0:
                radiance += strength * mirrored[:, None]
            radiance *= intensity
            unfiltered += radiance
            for lens, local, way, outside, reach in near:
                along = way @ toward
                ray = np.flatnonzero((facing > 0) & (along >= -reach) & (along**2 >= outside))
                ray = ray[lens.caster.occluded(local[ray], toward, local=True)]
                taken = radiance[ray] * (1 - lens.material.transmission)
                lost[ray] += taken
                radiance[ray] -= taken
        return np.stack([unfiltered, np.maximum(unfiltered - lost, 0.0)])


@dataclass(frozen=True)
class PhotographedScene:
    """A linear photograph (H, W, 3) as the source of colours: points are looked up where the camera saw them.

    Points that were not seen take the colour of the nearest one of their surface among the pixels of
    `region`, or their albedo where there is none. Nothing is taken from fringes.
    """

    scene: LensScene
    picture: FloatArray
    camera: FloatArray
    region: tuple[slice, slice]
    environment: FloatArray | None = None
    _known: dict[int, tuple[cKDTree, FloatArray]] = field(default_factory=dict)

    @cached_property
    def _center(self) -> FloatArray:
        return camera_centers(self.camera)

    def look(self, straight: SceneRays, bent: SceneRays, mirrored: Sequence[SceneRays]) -> list[RayColors]:
        """Return the photograph's own pixels for straight rays, and what it shows of the others' ends."""
        assert straight.pixels is not None
        last = np.array(self.picture.shape[1::-1]) - 1
        column, row = np.clip(np.round(straight.pixels).astype(int), 0, last).T
        return [RayColors.known(self.picture[row, column]), self.seen(bent), *map(self.mirrored, mirrored)]

    def seen(self, rays: SceneRays) -> RayColors:
        """Return what the photograph shows at the ends of rays, and where it does not."""
        linear, unknown = np.zeros((len(rays.origins), 3)), np.zeros(len(rays.origins), bool)
        hit = rays.hits.face >= 0
        if hit.any():
            on = rays.chosen(hit)
            position, surface = on.ends, self.scene.surface_of_face[on.hits.face]
            colors, sampled = self._sample(project(self.camera, position)[0], surface)
            distance = norms(position - self._center)
            first = self.scene.rays(self._center, (position - self._center) / distance[:, None])
            known = sampled & (first.hits.distance >= distance - _SAME_POINT * self.scene.caster.size)
            for number in np.unique(surface[~known]).tolist():
                lost = ~known & (surface == number)
                if number not in self._known:
                    # The points of the surface that pixels of the region show, and their colours.
                    corner = [part.start or 0 for part in self.region]
                    row, column = (np.argwhere(self._labels[self.region] == number) + corner).T
                    way = pixel_directions(self.camera, np.stack([column, row], 1))
                    ends = self.scene.rays(self._center, way)
                    met = np.flatnonzero(ends.hits.face >= 0)
                    self._known[number] = cKDTree(ends.chosen(met).ends), self.picture[row[met], column[met]]
                tree, shown = self._known[number]
                if len(shown):
                    colors[lost] = shown[tree.query(position[lost])[1]]
                else:
                    colors[lost] = self.scene.albedo(on.chosen(lost))
            linear[hit], unknown[hit] = colors, ~known
        if not hit.all():
            # A background far away; where the photograph shows none there, that which is seen as near as
            # possible to the lens itself: surfaces may hide a ray's own direction over long stretches.
            past = rays.chosen(~hit)
            pixels, _ = project(self.camera, self._center + past.directions)
            colors, known = self._sample(pixels, np.full(len(pixels), _AWAY))
            places = np.argwhere(self._labels == _AWAY)
            if len(places) and not known.all():
                at, _ = project(self.camera, past.origins[~known])
                row, column = places[cKDTree(places).query(at[:, ::-1])[1]].T
                colors[~known] = self.picture[row, column]
            linear[~hit], unknown[~hit] = colors, ~known
        return RayColors.known(linear, unknown)

    def mirrored(self, rays: SceneRays) -> RayColors:
        """Return what mirrors show: points of the photograph, or the environment."""
        hit = rays.hits.face >= 0
        linear, unknown = radiance_at(self.environment, rays.directions), np.zeros(len(hit), bool)
        on_surface = self.seen(rays.chosen(hit))
        linear[hit], unknown[hit] = on_surface.bare, on_surface.unknown
        return RayColors.known(linear, unknown)

    def matte(self, position: FloatArray, normal: FloatArray, albedo: FloatArray) -> FloatArray:
        """Return the tint as it is: its light is the photograph's."""
        return np.broadcast_to(albedo, position.shape)

    @cached_property
    def _labels(self) -> IntArray:
        """(H, W) what each pixel shows."""
        shape = self.picture.shape[:2]
        face = self.scene.rays(self._center, pixel_directions(self.camera, pixel_grid(shape))).hits.face
        label = np.where(face >= 0, self.scene.surface_of_face[face], _AWAY).reshape(shape)
        frame, away = label == 0, label == _AWAY
        for kind, others in ((frame, ~frame), (~away, away)):
            label[binary_dilation(kind, np.ones((3, 3))) & others] = _MIXED
        return label

    def _sample(self, pixels: FloatArray, labels: IntArray) -> tuple[FloatArray, BoolArray]:
        """Return bilinear colours (N, 3) from pixels of the given labels, and where there are any."""
        at = np.where(np.isfinite(pixels), pixels, -1.0)
        inside = within(at, self._labels.shape)
        total = np.zeros((len(at), 4))
        for number in np.unique(labels):
            own, wanted = (self._labels == number)[..., None], labels == number
            total[wanted] = bilinear(np.concatenate([own * self.picture, own], 2), at[wanted])
        share = total[:, 3]
        return total[:, :3] / np.where(share > 0, share, 1.0)[:, None], inside & (share >= _LEAST_SHARE)


SceneColors = LitScene | PhotographedScene
