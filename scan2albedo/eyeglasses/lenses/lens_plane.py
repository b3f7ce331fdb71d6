"""The plane of a lens and polar coordinates in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scan2albedo.errors import EyeglassesError
from scan2albedo.geometry.mesh import normalized

FloatArray = NDArray[np.float64]

_FLAT = 0.05
"""Spread of rim points across their longest direction below which they are a line and hold no plane."""


@dataclass(frozen=True)
class RimProfile:
    """An outline around a lens centre: (R,) radius and height over the plane at given angles."""

    radius: FloatArray
    height: FloatArray


@dataclass(frozen=True)
class LensPlane:
    """A plane through a lens centre; angles run from `across` to `up`, counterclockwise for the viewer."""

    center: FloatArray
    """(3,)"""
    across: FloatArray
    """(3,) unit."""
    up: FloatArray
    """(3,) unit."""
    normal: FloatArray
    """(3,) unit, towards the viewer."""

    @classmethod
    def at(cls, center: FloatArray, normal: FloatArray) -> LensPlane:
        """Return the plane across `normal` (3,) of any length."""
        axis = normalized(normal)
        if not np.isfinite(axis).all() or not axis.any():
            raise EyeglassesError(f"a lens plane needs a finite normal, not zero, got {normal.tolist()}")
        across = normalized(np.cross(np.eye(3)[np.argmin(np.abs(axis))], axis))
        return cls(center, across, np.cross(axis, across), axis)

    def directions(self, angles: FloatArray) -> FloatArray:
        """Return (N, 3) unit vectors in the plane."""
        return np.cos(angles)[:, None] * self.across + np.sin(angles)[:, None] * self.up

    def points(self, angles: FloatArray, profile: RimProfile) -> FloatArray:
        """Return (N, 3) points of an outline."""
        return (
            self.center
            + profile.radius[:, None] * self.directions(angles)
            + profile.height[:, None] * self.normal
        )

    def angles(self, points: FloatArray) -> FloatArray:
        """Return (N,) rad."""
        offset = points - self.center
        return np.arctan2(offset @ self.up, offset @ self.across)

    def profile(self, points: FloatArray) -> RimProfile:
        """Return radius and height of points (N, 3)."""
        offset = points - self.center
        return RimProfile(np.hypot(offset @ self.across, offset @ self.up), offset @ self.normal)


def fit_normal(rim_points: FloatArray, vertices: FloatArray) -> FloatArray:
    """Return the unit normal (3,) of the plane nearest to rim points (K, 3), away from most of the frame.

    Behind the lenses are the temples, so the side that holds less of the frame is the viewer's.
    """
    offset = rim_points - rim_points.mean(0)
    _, spread, axes = np.linalg.svd(offset, full_matrices=False)
    if len(rim_points) < 3 or spread[1] <= _FLAT * spread[0]:
        raise EyeglassesError("rim points on one line hold no lens plane; give three or more around the lens")
    behind = (vertices - rim_points.mean(0)) @ axes[2]
    return -axes[2] if behind.mean() > 0 else axes[2]
