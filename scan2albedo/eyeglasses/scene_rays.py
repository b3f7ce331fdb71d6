"""What pictures of a scene are asked for: rays with what they hit, and the colours they see."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

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
class SeenColors:
    """Colours at the ends of N rays."""

    linear: FloatArray
    """(N, 3)."""
    unknown: BoolArray
    """(N,) True where the colour is a guess."""


@dataclass(frozen=True)
class StraightColors:
    """Colours of pixels that no lens bends; (N, 3) linear."""

    bare: FloatArray
    """Without any lenses in the scene."""
    shaded: FloatArray
    """With the light that lenses keep from the surfaces taken off."""


class SceneColors(Protocol):
    """A source of colours: a lit scene, or a photograph of one."""

    def straight(self, pixels: FloatArray, rays: SceneRays) -> StraightColors:
        """Return colours of straight rays through pixels (N, 2)."""

    def seen(self, rays: SceneRays) -> SeenColors:
        """Return colours of rays behind a lens."""

    def mirrored(self, rays: SceneRays) -> SeenColors:
        """Return colours of rays that a lens mirrors."""

    def matte(self, position: FloatArray, normal: FloatArray, albedo: FloatArray) -> FloatArray:
        """Return (N, 3) colours of a matte plate (albedo (3,)) at points of a lens."""
