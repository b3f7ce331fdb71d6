"""Pictures of a scene with lenses, ray by ray."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scan2albedo.eyeglasses.inserted_lenses import InsertedLens
from scan2albedo.eyeglasses.lens_paths import LensCrossings, LensPaths, trace_lenses
from scan2albedo.eyeglasses.lens_scene import LensScene
from scan2albedo.eyeglasses.scene_rays import SceneColors, SceneRays
from scan2albedo.geometry.pinhole import camera_centers, pixel_directions, pixel_grid, project

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

_BAND = 2**18
"""Rays that are followed at once: a bound on memory."""
_JUMP_PX = 8.0
"""Step in depth between neighbouring pixels, in sizes of a pixel there, that is an edge."""


@dataclass(frozen=True)
class Rendering:
    """N rays or pixels of a picture."""

    linear: FloatArray
    """(N, 3)."""
    bare: FloatArray
    """(N, 3) without lenses."""
    lens: IntArray
    """(N,) side of the first lens, -1 for none."""
    unknown: BoolArray
    """(N,) whether colours are guesses."""
    surface: IntArray
    """(N,) number of the surface at the end, -1 for none."""
    distance: FloatArray
    """(N,) mm from the camera to the end; inf for none."""
    glancing: int
    """Rays that left out a lens."""


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

    def picture(self, window: PixelRegion, supersampling: int) -> Rendering:
        """Return the pixels of a window, row by row; those on edges are means of n x n rays."""
        pixels = pixel_grid(window.shape) + [window.left, window.top]
        once = self._rays(pixels)
        edge = np.flatnonzero(self._edges(once, window.shape))
        if supersampling == 1 or len(edge) == 0:
            return once
        steps = (np.arange(supersampling) + 0.5) / supersampling - 0.5
        offsets = np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2)
        fine = self._rays((pixels[edge, None] + offsets).reshape(-1, 2))
        bare = fine.bare.reshape(len(edge), -1, 3)
        change = (fine.linear - fine.bare).reshape(bare.shape)
        once.bare[edge] = bare[:, 0] + (bare - bare[:, :1]).mean(1)
        # Means of equal numbers may differ from them in the last digit; differences of 0 stay 0.
        once.linear[edge] = once.bare[edge] + change.mean(1)
        once.unknown[edge] = fine.unknown.reshape(len(edge), -1).any(1)
        return once

    def _edges(self, once: Rendering, shape: tuple[int, int]) -> BoolArray:
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

    def _rays(self, pixels: FloatArray) -> Rendering:
        """Return one ray through each of the pixels (N, 2)."""
        parts = [self._band(pixels[i : i + _BAND]) for i in range(0, len(pixels), _BAND)]
        arrays = ("linear", "bare", "lens", "unknown", "surface", "distance")
        joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in arrays}
        return Rendering(**joined, glancing=sum(part.glancing for part in parts))

    def _band(self, pixels: FloatArray) -> Rendering:
        directions = pixel_directions(self._camera, pixels)
        origins = np.broadcast_to(self._center, directions.shape)
        straight = SceneRays(origins, directions, self._scene.caster.first_hit(origins, directions))
        near = np.flatnonzero(self._region.holds(pixels))
        some = straight.chosen(near)
        paths = trace_lenses(self._scene, self._lenses, self._center, some.directions, some.hits)
        colors = self._colors.straight(pixels, straight)
        linear, unknown = colors.shaded.copy(), np.zeros(len(pixels), bool)
        linear[near], unknown[near] = self._through(paths, linear[near])
        lens, face = np.full(len(pixels), -1), straight.hits.face.copy()
        lens[near], face[near] = paths.first, paths.hits.face
        distance = straight.hits.distance.copy()
        ends = paths.origins + paths.hits.distance[:, None] * paths.directions
        distance[near] = np.linalg.norm(ends - self._center, axis=1)
        surface = np.where(face >= 0, self._scene.surface_of_face[face], -1)
        return Rendering(linear, colors.bare, lens, unknown, surface, distance, paths.glancing)

    def _through(self, paths: LensPaths, straight: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Return colours (N, 3) of rays, lenses included, and which are guesses."""
        bent = np.flatnonzero(paths.bent)
        seen = self._colors.seen(SceneRays(paths.origins, paths.directions, paths.hits).chosen(bent))
        behind, unknown = straight.copy(), np.zeros(len(straight), bool)
        behind[bent], unknown[bent] = seen.linear, seen.unknown
        linear = paths.share * behind
        for crossings in paths.crossings:
            linear[crossings.ray] += self._tint(crossings)
            mirrored = np.flatnonzero(crossings.mirror_share.any(1))
            if len(mirrored):
                rays = self._mirrored(crossings, mirrored)
                reflected = self._colors.mirrored(rays)
                at = crossings.ray[mirrored]
                linear[at] += crossings.mirror_share[mirrored] * reflected.linear
                unknown[at] |= reflected.unknown
        return linear, unknown

    def _tint(self, crossings: LensCrossings) -> FloatArray:
        """Return (M, 3) what a painted tint adds."""
        tint = np.asarray(crossings.lens.material.tint_linear)
        if not crossings.tint_share.any() or not tint.any():
            return np.zeros_like(crossings.tint_share)
        normal = np.asarray(crossings.lens.optics.normal)
        toward_viewer = -np.sign(crossings.direction @ normal)[:, None] * normal
        return crossings.tint_share * self._colors.matte(crossings.position, toward_viewer, tint)

    def _mirrored(self, crossings: LensCrossings, which: IntArray) -> SceneRays:
        origins, directions = crossings.position[which], crossings.mirrored[which]
        return SceneRays(origins, directions, self._scene.caster.first_hit(origins, directions))
