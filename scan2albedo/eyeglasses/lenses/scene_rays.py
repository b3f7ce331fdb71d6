"""What pictures of a scene are asked for: rays with what they hit, and the colours they see in any light."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from scan2albedo.eyeglasses.lenses.environment_map import map_places, radiance_at
from scan2albedo.geometry.rays import RayHits

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


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
    """(H, W, 3) radiance of what is far away; None is black."""


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
