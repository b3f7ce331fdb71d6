"""Rays of a picture with lenses, light left out: colours in any light follow from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scan2albedo.eyeglasses.lenses.scene_rays import Illumination, RayColors, RaySamples

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


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
    """(M, 3) of what lies behind in their colours."""
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
