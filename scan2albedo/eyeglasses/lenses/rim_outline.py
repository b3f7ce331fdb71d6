"""The inner edge of a rim around a lens centre: by rays outward, or by subdivision of its key points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.errors import EyeglassesError
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.rays import RayCaster

_FLAT = 0.05
"""Spread of rim points across their longest direction below which they are a line and hold no plane."""
_REACH = 0.16
"""Heights looked at over and under the plane, in lens radii: a curved rim leaves the plane by about 0.1."""
_HEIGHTS = 33
_REFINEMENTS, _FINER = (0.006, 0.002), 9
"""Then heights around the neighbourhood's: single rays meet ends of bridges that poke through."""
_NEAREST, _FARTHEST = 0.4, 1.5
"""Hits outside this range, in lens radii, are a nose pad, the other rim or a temple."""
_WINDOW_RAD = 0.2
_DENT = 0.0025
"""Part of the radius by which the edge may lie inside a chord between its neighbours."""
_STEP = 0.05
"""Lens radii between neighbouring hits that part two surfaces, such as the outer wall seen in a cut tube."""
_JUMP = 0.12
"""Hits this much off the median of their neighbourhood, in lens radii, are something in the way."""
_LEVELS = 5
_PULL = 0.25
"""Part of an edge's length within which a vertex draws its middle: farther off is another piece of frame."""


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
    """Return the unit normal (3,) of the plane nearest to rim points (K, 3), towards the viewer.

    The temples are behind the lenses, so the viewer is on the side that holds less of the frame.
    """
    offset = rim_points - rim_points.mean(0)
    _, spread, axes = np.linalg.svd(offset, full_matrices=False)
    if len(rim_points) < 3 or spread[1] <= _FLAT * spread[0]:
        raise EyeglassesError("rim points on one line hold no lens plane; give three or more around the lens")
    behind = (vertices - rim_points.mean(0)) @ axes[2]
    return -axes[2] if behind.mean() > 0 else axes[2]


def shoot_rim(
    caster: RayCaster, plane: LensPlane, angles: FloatArray, lens_radius: float | None
) -> RimProfile:
    """Return the rim's inner edge (R,) at each of ascending even angles (R,), NaN where there is none.

    A single ray in the plane would meet a curved rim anywhere on its flank. Rays leave at several heights,
    and the one that meets the rim first meets its inner edge; then the heights next to it are searched. The
    lens radius is roughly known, or else the median of what rays in the plane hit.
    """
    missing = np.full(len(angles), np.nan)
    if lens_radius is None:
        flat = _shoot(caster, plane, angles, np.zeros((len(angles), 1)))
        if not np.isfinite(flat).any():
            return RimProfile(missing, missing)
        lens_radius = float(np.median(flat[np.isfinite(flat)]))
    level = np.zeros(len(angles))
    radius, height = _nearest(caster, plane, angles, level, lens_radius, _REACH, _HEIGHTS)
    # A plane some degrees off leaves the rim on two sides: sweep again around the tilt that was found.
    level = _tilt(angles, height, np.isfinite(radius))
    radius, height = _nearest(caster, plane, angles, level, lens_radius, _REACH, _HEIGHTS)
    for reach in _REFINEMENTS:
        level = _local_median(height, np.isfinite(radius))
        radius, height = _nearest(caster, plane, angles, level, lens_radius, reach, _FINER)
    found = np.isfinite(radius)
    found &= ~(np.abs(radius - _local_median(radius, found)) > _JUMP * lens_radius)
    found &= ~_stray(np.where(found, radius / lens_radius, np.nan))
    # The ray beside a gap may have met the cut instead of the edge.
    found &= np.roll(found, 1) & np.roll(found, -1)
    found &= ~_dents(np.where(found, radius, np.nan))
    return RimProfile(np.where(found, radius, np.nan), np.where(found, height, np.nan))


def _tilt(angles: FloatArray, height: FloatArray, known: BoolArray) -> FloatArray:
    """Return heights (R,) of the plane nearest to the known ones; 0 where less than half are."""
    if known.sum() < len(known) / 2:
        return np.zeros(len(angles))
    basis = np.stack([np.ones(len(angles)), np.cos(angles), np.sin(angles)], 1)
    return basis @ np.linalg.lstsq(basis[known], height[known], rcond=None)[0]


def _stray(radius: FloatArray) -> BoolArray:
    """Return (R,) True for hits on pieces that less than half the window sees; NaN is none."""
    count = len(radius)
    steepest = max(_STEP, 2 * np.pi / count)
    starts: IntArray = np.flatnonzero(~(np.abs(radius - np.roll(radius, 1)) <= steepest))
    stray = np.zeros(count, bool)
    for first, following in zip(starts, np.append(starts[1:], starts[:1] + count), strict=True):
        if following - first < _half_window(count):
            stray[np.arange(first, following) % count] = True
    return stray


def _dents(radius: FloatArray) -> BoolArray:
    """Return (R,) True where the edge lies inside a chord between two points nearby; NaN is no point.

    Rims are convex over so short a way. Ends of bridges and solder poke through them.
    """
    dent = np.zeros(len(radius), bool)
    for k in range(1, _half_window(len(radius)) + 1):
        before, after = np.roll(radius, k), np.roll(radius, -k)
        chord = 2 * before * after * np.cos(2 * np.pi * k / len(radius)) / (before + after)
        dent |= radius < (1 - _DENT) * chord
    return dent


def _nearest(
    caster: RayCaster,
    plane: LensPlane,
    angles: FloatArray,
    level: FloatArray,
    lens_radius: float,
    reach: float,
    count: int,
) -> tuple[FloatArray, FloatArray]:
    """Return the least distance (R,) within `reach` of heights `level` (R,), inf for none, and its height."""
    heights = level[:, None] + lens_radius * np.linspace(-reach, reach, count)
    distance = _shoot(caster, plane, angles, heights)
    # What is far too near is in the way: the rim may be seen past it at other heights.
    distance[(distance < _NEAREST * lens_radius) | (distance > _FARTHEST * lens_radius)] = np.inf
    first = distance.argmin(1)[:, None]
    return np.take_along_axis(distance, first, 1)[:, 0], np.take_along_axis(heights, first, 1)[:, 0]


def _shoot(caster: RayCaster, plane: LensPlane, angles: FloatArray, heights: FloatArray) -> FloatArray:
    """Return (R, H) distances from the axis outward, inf for none, at heights (R, H)."""
    origins = plane.center + heights[..., None] * plane.normal
    headings = np.repeat(plane.directions(angles), heights.shape[1], axis=0)
    return caster.first_hit(origins.reshape(-1, 3), headings).distance.reshape(heights.shape)


def _local_median(values: FloatArray, known: BoolArray) -> FloatArray:
    """Return (R,) medians of means of two known values at equal distance; 0 where there are none.

    Pairs leave a steady slope unchanged, beside gaps too.
    """
    half = _half_window(len(values))
    around = (np.arange(len(values))[:, None] + np.arange(-half, half + 1)) % len(values)
    opposite = around[:, ::-1]
    pairs = np.ma.masked_array((values[around] + values[opposite]) / 2, ~(known[around] & known[opposite]))
    return np.ma.median(pairs, axis=1).filled(0.0)


def _half_window(count: int) -> int:
    return max(1, round(_WINDOW_RAD * count / (2 * np.pi)))


def subdivide_rim(
    vertices: FloatArray, plane: LensPlane, rim_points: FloatArray, angles: FloatArray
) -> RimProfile:
    """Return an outline through rim points (K, 3), K >= 3, at ascending angles (R,).

    Each level puts a point into the middle of every edge, by the four-point rule (9 (b + c) - a - d) / 16
    [1]_, and moves it to the closest vertex of the frame if there is one near; where the frame is open the
    curve stays round. It follows whichever side of the rim's tube the vertices are on: up to 4.5 mm off on
    synthetic frames. Rays are better wherever they hit.

    .. [1] N. Dyn, D. Levin, J. A. Gregory, "A 4-point interpolatory subdivision scheme for curve design",
       Computer Aided Geometric Design 4, 1987, equation 1.2 with w = 1/16.
    """
    outline = rim_points[np.argsort(plane.angles(rim_points))]
    tree = cKDTree(vertices)
    for _ in range(_LEVELS):
        following = np.roll(outline, -1, 0)
        middle = (9 * (outline + following) - np.roll(outline, 1, 0) - np.roll(outline, -2, 0)) / 16
        distance, nearest = tree.query(middle)
        pulled = distance <= _PULL * np.linalg.norm(following - outline, axis=1)
        middle[pulled] = vertices[nearest[pulled]]
        outline = np.stack([outline, middle], 1).reshape(-1, 3)
        # Two middles drawn to one vertex would leave an edge without length.
        outline = outline[np.linalg.norm(outline - np.roll(outline, 1, 0), axis=1) > 0]
    return _resampled(plane, outline, angles)


def _resampled(plane: LensPlane, outline: FloatArray, angles: FloatArray) -> RimProfile:
    """Return the outline at the given angles, seen from the centre."""
    at, own = plane.angles(outline), plane.profile(outline)
    return RimProfile(
        np.interp(angles, at, own.radius, period=2 * np.pi),
        np.interp(angles, at, own.height, period=2 * np.pi),
    )
