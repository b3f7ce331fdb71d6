"""Pictures of a scene with lenses, ray by ray, and the same pictures in another light."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.lenses.inserted_lenses import InsertedLens
from scan2albedo.eyeglasses.lenses.lens_paths import LensPaths, trace_lenses
from scan2albedo.eyeglasses.lenses.lens_scene import LensScene
from scan2albedo.eyeglasses.lenses.traced_rays import (
    AddedColors,
    Illumination,
    RayColors,
    RayEnds,
    SceneColors,
    SceneRays,
    TracedPicture,
    TracedRays,
    with_means,
)
from scan2albedo.geometry.pinhole import camera_centers, pixel_directions, pixel_grid, project
from scan2albedo.lighting.environment import DistantLights, MapCells, map_cells

_BAND = 2**18
"""Rays that are followed at once: a bound on memory."""
_JUMP_PX = 8.0
"""Step in depth between neighbouring pixels, in sizes of a pixel there, that is an edge."""
_NEGLIGIBLE = 1e-12
"""Part of all light below which a light may be left out."""


@dataclass(frozen=True)
class Rendering:
    """N pixels of a picture, row by row."""

    colors: RayColors
    lens: IntArray
    """(N,) side of the first lens, -1 for none."""
    unknown: BoolArray
    """(N,) whether colours are guesses."""
    glancing: int
    """Rays that left out a lens."""
    traced: TracedPicture | None
    """What gives the colours in another light, if it was kept."""


@dataclass(frozen=True)
class _Batch:
    """Rays in a row, in parts."""

    ends: RayEnds
    colors: tuple[RayColors, ...]
    traced: tuple[TracedRays, ...]


@dataclass(frozen=True)
class PixelRegion:
    """A rectangle of pixels; `right` and `bottom` are the first that do not belong to it."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width)."""
        return max(self.bottom - self.top, 0), max(self.right - self.left, 0)

    @property
    def slices(self) -> tuple[slice, slice]:
        """Rows and columns of a picture."""
        return slice(self.top, self.top + self.shape[0]), slice(self.left, self.left + self.shape[1])

    def holds(self, pixels: FloatArray) -> BoolArray:
        """Return (N,) whether pixels (N, 2) lie inside, to half a pixel."""
        low, high = [self.left - 0.5, self.top - 0.5], [self.right - 0.5, self.bottom - 0.5]
        return np.asarray(((pixels >= low) & (pixels < high)).all(1))

    @classmethod
    def of_lenses(
        cls, lenses: Sequence[InsertedLens], camera: FloatArray, shape: tuple[int, int]
    ) -> PixelRegion:
        """Return the pixels of a picture that may see a lens, with one to spare around them."""
        if not lenses:
            return cls(0, 0, 0, 0)
        pixels, depth = project(camera, np.concatenate([lens.vertices for lens in lenses]))
        height, width = shape
        if (depth <= 0).any():
            return cls(0, 0, 0, 0) if (depth <= 0).all() else cls(0, 0, width, height)
        low = np.clip(np.floor(pixels.min(0)) - 1, 0, [width, height]).astype(int)
        high = np.clip(np.ceil(pixels.max(0)) + 2, 0, [width, height]).astype(int)
        return cls(int(low[0]), int(low[1]), int(high[0]), int(high[1]))


class LensRenderer:
    """A camera (3, 4), normalised, before a scene with lenses, which only pixels of `region` may see."""

    def __init__(
        self,
        scene: LensScene,
        lenses: Sequence[InsertedLens],
        colors: SceneColors,
        camera: FloatArray,
        region: PixelRegion,
    ) -> None:
        self._scene, self._lenses, self._colors = scene, lenses, colors
        self._camera, self._center = camera, camera_centers(camera[None])[0]
        self._region = region

    def picture(
        self, window: PixelRegion, supersampling: int, light: Illumination, *, keep: bool = False
    ) -> Rendering:
        """Return the pixels of a window; those on edges are means of n x n rays.

        With `keep` the rendering keeps its rays, which take some 150 bytes each and one for each light.
        """
        pixels = pixel_grid(window.shape) + [window.left, window.top]
        once = self._rays(pixels, light, keep, window.shape[1])
        edge = np.flatnonzero(self._edges(once.ends, window.shape))
        unknown, fine = once.ends.unknown.copy(), _Batch(once.ends, (), ())
        if supersampling == 1 or len(edge) == 0:
            edge = edge[:0]
        else:
            steps = (np.arange(supersampling) + 0.5) / supersampling - 0.5
            offsets = np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2)
            fine = self._rays((pixels[edge, None] + offsets).reshape(-1, 2), light, keep, len(offsets))
            unknown[edge] = fine.ends.unknown.reshape(len(edge), -1).any(1)
        return Rendering(
            with_means(once.colors, edge, fine.colors),
            once.ends.lens,
            unknown,
            once.ends.glancing,
            TracedPicture(once.traced, edge, fine.traced) if keep else None,
        )

    def _edges(self, once: RayEnds, shape: tuple[int, int]) -> BoolArray:
        """Return (N,) pixels whose ray differs from a neighbour's in lens, surface or distance."""
        kind = (once.lens + (once.surface + 1) * 4).reshape(shape)
        focal = np.sqrt(np.abs(np.linalg.det(self._camera[:, :3])))
        distance = np.where(np.isfinite(once.distance), once.distance, 0.0).reshape(shape)
        edge = np.zeros(shape, bool)
        for axis in (0, 1):
            across, kinds, mark = (np.moveaxis(a, axis, 0) for a in (distance, kind, edge))
            pixel_mm = np.minimum(across[1:], across[:-1]) / focal
            step = (kinds[1:] != kinds[:-1]) | (np.abs(across[1:] - across[:-1]) > _JUMP_PX * pixel_mm)
            mark[1:] |= step
            mark[:-1] |= step
        return edge.ravel()

    def _rays(self, pixels: FloatArray, light: Illumination, keep: bool, together: int) -> _Batch:
        """Return one ray through each of the pixels (N, 2); groups of `together` stay in one part."""
        ends, colors, kept = [], [], []
        size = max(_BAND // max(together, 1), 1) * max(together, 1)
        for start in range(0, max(len(pixels), 1), size):
            traced = self._band(pixels[start : start + size])
            ends.append(traced.ends)
            colors.append(traced.colors(light))
            if keep:
                kept.append(traced)
        return _Batch(RayEnds.joined(ends), tuple(colors), tuple(kept))

    def _band(self, pixels: FloatArray) -> TracedRays:
        directions = pixel_directions(self._camera, pixels)
        origins = np.broadcast_to(self._center, directions.shape)
        straight = SceneRays(origins, directions, self._scene.caster.first_hit(origins, directions))
        near = np.flatnonzero(self._region.holds(pixels))
        some = straight.chosen(near)
        paths = trace_lenses(self._scene, self._lenses, self._center, some.directions, some.hits)
        bent = np.flatnonzero(paths.bent)
        seen = self._colors.seen(SceneRays(paths.origins, paths.directions, paths.hits).chosen(bent))
        added = tuple(self._added(paths, near))
        unknown = np.zeros(len(pixels), bool)
        for ray, samples in ((near[bent], seen), *((a.ray, a.samples) for a in added)):
            unknown[ray] |= samples.unknown
        return TracedRays(
            self._colors.straight(pixels, straight),
            near,
            paths.share,
            bent,
            seen,
            added,
            self._ends(straight, near, paths, unknown),
        )

    def _ends(self, straight: SceneRays, near: IntArray, paths: LensPaths, unknown: BoolArray) -> RayEnds:
        lens, face = np.full(len(unknown), -1), straight.hits.face.copy()
        lens[near], face[near] = paths.first, paths.hits.face
        distance = straight.hits.distance.copy()
        ends = paths.origins + paths.hits.distance[:, None] * paths.directions
        distance[near] = np.linalg.norm(ends - self._center, axis=1)
        surface = np.where(face >= 0, self._scene.surface_of_face[face], -1)
        return RayEnds(lens, surface, distance, unknown, paths.glancing)

    def _added(self, paths: LensPaths, near: IntArray) -> Iterator[AddedColors]:
        """Give what lenses add to the colours of the rays `near`: tints and reflections."""
        for crossings in paths.crossings:
            tint = np.asarray(crossings.lens.material.tint_linear)
            if crossings.tint_share.any() and tint.any():
                normal = np.asarray(crossings.lens.optics.normal)
                toward_viewer = -np.sign(crossings.direction @ normal)[:, None] * normal
                plate = self._colors.matte(crossings.position, toward_viewer, tint)
                yield AddedColors(near[crossings.ray], crossings.tint_share, plate)
            which = np.flatnonzero(crossings.mirror_share.any(1))
            if len(which):
                origins, directions = crossings.position[which], crossings.mirrored[which]
                rays = SceneRays(origins, directions, self._scene.caster.first_hit(origins, directions))
                reflected = self._colors.mirrored(rays)
                yield AddedColors(near[crossings.ray[which]], crossings.mirror_share[which], reflected)


def checked_image(name: str, values: ArrayLike) -> FloatArray:
    """Return a finite image (H, W, 3). Raises EyeglassesError if not finite, ValueError for its shape."""
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
