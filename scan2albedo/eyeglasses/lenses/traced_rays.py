"""Rays of a picture with lenses, light left out: colours in any light follow from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.eyeglasses.lenses.lens_shading import map_places, radiance_at
from scan2albedo.geometry.rays import RayHits


@dataclass(frozen=True)
class SceneRays:
    """N rays and where they end in the scene."""

    origins: FloatArray
    """(N, 3) mm."""
    directions: FloatArray
    """(N, 3) unit."""
    hits: RayHits

    def chosen(self, which: IntArray | BoolArray) -> SceneRays:
        """Return some of the rays."""
        hits = RayHits(self.hits.face[which], self.hits.barycentric[which], self.hits.distance[which])
        return SceneRays(self.origins[which], self.directions[which], hits)


@dataclass(frozen=True)
class Illumination:
    """The light of a picture; everything in it is linear in both."""

    irradiance_linear: FloatArray
    """(K, 3) of distant lights; none in a photograph."""
    environment_linear: FloatArray | None
    """(H, W, 3) radiance from far away; None is black."""


@dataclass(frozen=True)
class RayColors:
    """Linear colours of N rays."""

    bare: FloatArray
    """(N, 3) without any lenses in the scene."""
    shaded: FloatArray
    """(N, 3) with the light that lenses keep from the surfaces taken off."""


class RaySamples(Protocol):
    """All about N rays that their colours depend on but for the light."""

    @property
    def unknown(self) -> BoolArray:
        """(N,) True where the colour is a guess."""

    def colors(self, light: Illumination) -> RayColors:
        """Return the colours in a light."""


class SceneColors(Protocol):
    """A source of colours: a lit scene, or a photograph of one."""

    def straight(self, pixels: FloatArray, rays: SceneRays) -> RaySamples:
        """Look at straight rays through pixels (N, 2)."""

    def seen(self, rays: SceneRays) -> RaySamples:
        """Look at rays behind a lens."""

    def mirrored(self, rays: SceneRays) -> RaySamples:
        """Look at rays that a lens mirrors."""

    def matte(self, position: FloatArray, normal: FloatArray, albedo: FloatArray) -> RaySamples:
        """Look at a matte plate (albedo (3,)) at points of a lens."""


@dataclass(frozen=True)
class Surroundings:
    """Those of N rays that meet nothing and see what is far away."""

    ray: IntArray
    """(M,)"""
    place: FloatArray
    """(M, 2) in any environment map."""

    @classmethod
    def of(cls, rays: SceneRays) -> Surroundings:
        """Return where the rays without a hit look."""
        ray = np.flatnonzero(rays.hits.face < 0)
        return cls(ray, map_places(rays.directions[ray]))

    @classmethod
    def none(cls) -> Surroundings:
        """Return no rays."""
        return cls(np.zeros(0, np.int64), np.zeros((0, 2)))

    def add(self, linear: FloatArray, light: Illumination) -> None:
        """Add to (N, 3) colours of rays what they see of the surroundings."""
        if light.environment_linear is not None:
            linear[self.ray] += radiance_at(light.environment_linear, self.place)


@dataclass(frozen=True)
class KnownSamples:
    """Rays whose colours are known, but for the surroundings that some see."""

    linear: FloatArray
    """(N, 3)"""
    unknown: BoolArray
    """(N,)"""
    surroundings: Surroundings

    def colors(self, light: Illumination) -> RayColors:
        """Return the colours in a light, with lenses and without."""
        linear = self.linear.copy()
        self.surroundings.add(linear, light)
        return RayColors(linear, linear)


@dataclass(frozen=True)
class RayEnds:
    """What N rays see."""

    lens: IntArray
    """(N,) side of the first lens, -1 for none."""
    surface: IntArray
    """(N,) number of the surface at the end, -1 for none."""
    distance: FloatArray
    """(N,) mm from the camera to the end; inf for none."""
    unknown: BoolArray
    """(N,) whether colours are guesses."""
    glancing: int
    """Rays that left out a lens."""

    @classmethod
    def joined(cls, parts: Sequence[RayEnds]) -> RayEnds:
        """Return the rays of one or more parts in a row."""
        lens, surface, unknown = (
            np.concatenate([getattr(part, name) for part in parts]) for name in ("lens", "surface", "unknown")
        )
        distance = np.concatenate([part.distance for part in parts])
        return cls(lens, surface, distance, unknown, sum(part.glancing for part in parts))


@dataclass(frozen=True)
class AddedColors:
    """What a lens adds to the colours of rays (M,) by shares (M, 3): its tint, or what it mirrors."""

    ray: IntArray
    share: FloatArray
    samples: RaySamples


@dataclass(frozen=True)
class TracedRays:
    """N rays."""

    straight: RaySamples
    """Of all rays, as if there were no lenses."""
    near: IntArray
    """(M,) rays that may see a lens."""
    share: FloatArray
    """(M, 3) of the scene behind the lenses in their colours."""
    bent: IntArray
    """(B,) of the M rays, those that see something else than straight ones."""
    seen: RaySamples
    """(B,)"""
    added: tuple[AddedColors, ...]
    ends: RayEnds

    def colors(self, light: Illumination) -> RayColors:
        """Return the colours in a light: bare, and with all that lenses do."""
        straight = self.straight.colors(light)
        linear = straight.shaded.copy()
        behind = linear[self.near]
        behind[self.bent] = self.seen.colors(light).shaded
        linear[self.near] = self.share * behind
        for added in self.added:
            linear[added.ray] += added.share * added.samples.colors(light).shaded
        return RayColors(straight.bare, linear)


@dataclass(frozen=True)
class TracedPicture:
    """All rays of a picture."""

    once: tuple[TracedRays, ...]
    """One ray through each pixel, row by row."""
    edge: IntArray
    """(E,) pixels whose colours are means."""
    fine: tuple[TracedRays, ...]
    """The rays of these means, as many for each, pixel by pixel."""

    def colors(self, light: Illumination) -> RayColors:
        """Return the colours of pixels in a light."""
        once, fine = ([part.colors(light) for part in parts] for parts in (self.once, self.fine))
        return with_means(once, self.edge, fine)


def with_means(once: Sequence[RayColors], edge: IntArray, fine: Sequence[RayColors]) -> RayColors:
    """Return colours of pixels: of one ray each, but at the edge pixels (E,) means of their fine rays."""
    bare, linear = (np.concatenate([getattr(c, name) for c in once]) for name in ("bare", "shaded"))
    if len(edge):
        parts, through = (
            np.concatenate([getattr(c, name) for c in fine]).reshape(len(edge), -1, 3)
            for name in ("bare", "shaded")
        )
        bare[edge] = parts[:, 0] + (parts - parts[:, :1]).mean(1)
        # Means of equal numbers may differ from them in the last digit; differences of 0 stay 0.
        linear[edge] = bare[edge] + (through - parts).mean(1)
    return RayColors(bare, linear)
