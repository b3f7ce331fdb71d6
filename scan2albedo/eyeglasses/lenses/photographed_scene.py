"""Colours of a scene from a photograph of it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.ndimage import binary_dilation
from scipy.spatial import cKDTree

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.eyeglasses.lenses.lens_scene import LensScene, SeenPoints
from scan2albedo.eyeglasses.lenses.traced_rays import KnownSamples, SceneRays, Surroundings
from scan2albedo.geometry.pinhole import camera_centers, pixel_directions, pixel_grid, project

_MIXED, _AWAY, _FRAME = -2, -1, 0
"""Labels of pixels: a fringe of nobody's, the background, then numbers of surfaces, the frame's first."""
_LEAST_SHARE = 0.2
"""Share of a bilinear sample that must lie on the wanted surface."""
_SAME_POINT = 3e-4
"""Distance between a point and what the camera sees in its direction, as a part of the scene's size, up to
which they are the same: embree's float32 picks a neighbouring face at times."""
_DARK = 1e-6
"""Albedos are at least this where brightness is divided by them."""


@dataclass(frozen=True)
class _ShownSurface:
    """What a photograph shows of a surface."""

    tree: cKDTree
    """Of points (N, 3)."""
    colors: FloatArray
    """(N, 3)."""
    brightness: FloatArray
    """(3,) colour by albedo."""


class PhotographedScene:
    """A linear photograph (H, W, 3) as the source of colours: points are looked up where the camera saw them.

    The scene is as photographed, the frame without lenses included. Points that were not seen take the colour
    of the nearest one of their surface among the pixels of `region`, or with `nearest` False its albedo in
    the photograph's brightness. Nothing is taken from `fringe_px` pixels around the frame and of the
    background around surfaces.
    """

    def __init__(
        self,
        scene: LensScene,
        picture: FloatArray,
        camera: FloatArray,
        *,
        nearest: bool,
        fringe_px: int,
        region: tuple[slice, slice],
    ) -> None:
        self._scene, self._picture, self._camera = scene, picture, camera
        self._center = camera_centers(camera[None])[0]
        self._nearest, self._fringe_px, self._region = nearest, fringe_px, region
        self._shown: dict[int, _ShownSurface] = {}

    def straight(self, pixels: FloatArray, rays: SceneRays) -> KnownSamples:
        """Return the photograph's own pixels."""
        last = np.array(self._picture.shape[1::-1]) - 1
        column, row = np.clip(np.round(pixels).astype(np.int64), 0, last).T
        return _known(self._picture[row, column], np.zeros(len(pixels), bool))

    def seen(self, rays: SceneRays) -> KnownSamples:
        """Return what the photograph shows at the ends of rays, and where it does not."""
        linear, unknown = np.zeros((len(rays.origins), 3)), np.zeros(len(rays.origins), bool)
        hit = rays.hits.face >= 0
        if hit.any():
            on = rays.chosen(hit)
            points = self._scene.points(on.origins, on.directions, on.hits)
            linear[hit], unknown[hit] = self._surface_colors(points)
        if not hit.all():
            linear[~hit], unknown[~hit] = self._background(rays.chosen(~hit))
        return _known(linear, unknown)

    def mirrored(self, rays: SceneRays) -> KnownSamples:
        """Return what mirrors show: points of the photograph, or the environment."""
        hit = rays.hits.face >= 0
        linear, unknown = np.zeros((len(hit), 3)), np.zeros(len(hit), bool)
        on_surface = self.seen(rays.chosen(hit))
        linear[hit], unknown[hit] = on_surface.linear, on_surface.unknown
        return KnownSamples(linear, unknown, Surroundings.of(rays))

    def matte(self, position: FloatArray, normal: FloatArray, albedo: FloatArray) -> KnownSamples:
        """Return the tint as it is: its light is the photograph's."""
        return _known(np.broadcast_to(albedo, position.shape), np.zeros(len(position), bool))

    @cached_property
    def _labels(self) -> IntArray:
        """(H, W) what each pixel shows."""
        shape = self._picture.shape[:2]
        directions = pixel_directions(self._camera, pixel_grid(shape))
        face = self._scene.caster.first_hit(np.broadcast_to(self._center, directions.shape), directions).face
        label = np.where(face >= 0, self._scene.surface_of_face[face], _AWAY).reshape(shape)
        if self._fringe_px:
            frame, away = label == _FRAME, label == _AWAY
            for kind, others in ((frame, ~frame), (~away, away)):
                label[binary_dilation(kind, np.ones((3, 3)), iterations=self._fringe_px) & others] = _MIXED
        return label

    def _surface_colors(self, points: SeenPoints) -> tuple[FloatArray, BoolArray]:
        pixels, _ = project(self._camera, points.position)
        linear, sampled = self._sample(pixels, points.surface)
        known = sampled & self._visible(points.position)
        for number in np.unique(points.surface[~known]):
            lost = ~known & (points.surface == number)
            linear[lost] = self._guess(points, lost, int(number))
        return linear, ~known

    def _visible(self, position: FloatArray) -> BoolArray:
        """Return (N,) whether the camera sees points of the surfaces."""
        offset = position - self._center
        distance = np.linalg.norm(offset, axis=1)
        toward = offset / distance[:, None]
        hits = self._scene.caster.first_hit(np.broadcast_to(self._center, toward.shape), toward)
        return np.asarray(hits.distance >= distance - _SAME_POINT * self._scene.caster.size)

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
        known = inside & (share >= _LEAST_SHARE)
        return total / np.where(share > 0, share, 1.0)[:, None], known

    def _background(self, rays: SceneRays) -> tuple[FloatArray, BoolArray]:
        """Return colours (N, 3) of a background far away, and where the photograph shows none there.

        Then the background is taken from as near as possible to where the lens itself is seen: surfaces may
        hide a ray's own direction over long stretches.
        """
        pixels, _ = project(self._camera, self._center + rays.directions)
        linear, known = self._sample(pixels, np.full(len(pixels), _AWAY))
        shown, tree = self._open_background
        if len(shown) and not known.all():
            at, _ = project(self._camera, rays.origins[~known])
            row, column = shown[tree.query(at[:, ::-1])[1]].T
            linear[~known] = self._picture[row, column]
        return linear, ~known

    @cached_property
    def _open_background(self) -> tuple[IntArray, cKDTree]:
        """Pixels (N, 2) (row, column) that show the background, and a tree of them."""
        shown = np.argwhere(self._labels == _AWAY)
        return shown, cKDTree(shown)

    def _guess(self, points: SeenPoints, lost: BoolArray, number: int) -> FloatArray:
        """Return (M, 3) colours for points of a surface that were not seen."""
        if number not in self._shown:
            self._shown[number] = self._find_shown(number)
        shown = self._shown[number]
        if self._nearest and len(shown.colors):
            return np.asarray(shown.colors[shown.tree.query(points.position[lost])[1]])
        return self._scene.albedo(points)[lost] * shown.brightness

    def _find_shown(self, number: int) -> _ShownSurface:
        """Return what the region's pixels show of a surface."""
        own = np.zeros(self._labels.shape, bool)
        own[self._region] = self._labels[self._region] == number
        rows, columns = np.nonzero(own)
        if len(rows) == 0:
            return _ShownSurface(cKDTree(np.zeros((0, 3))), np.zeros((0, 3)), np.ones(3))
        directions = pixel_directions(self._camera, np.stack([columns, rows], 1))
        origins = np.broadcast_to(self._center, directions.shape)
        hits = self._scene.caster.first_hit(origins, directions)
        on = hits.face >= 0
        rays = SceneRays(origins, directions, hits).chosen(np.flatnonzero(on))
        points = self._scene.points(rays.origins, rays.directions, rays.hits)
        colors, albedo = self._picture[rows[on], columns[on]], self._scene.albedo(points)
        brightness = np.median(colors, axis=0) / np.maximum(np.median(albedo, axis=0), _DARK)
        return _ShownSurface(cKDTree(points.position), colors, brightness)


def _known(linear: FloatArray, unknown: BoolArray) -> KnownSamples:
    return KnownSamples(linear, unknown, Surroundings.none())
