"""The inner rim of a frame around a lens centre, by rays outward or from its key points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.keypoints import checked_mesh, checked_points
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import normalized, vertex_components
from scan2albedo.geometry.rays import RayCaster

_POINTS, _PLACES = 128, 12
"""Points of a rim, and places on a circle, beside its centre, at which a lens is looked for."""
_GUESS = 0.15
"""Lens radius as a part of the mesh's longest side: 0.16 to 0.2 for a front, more for a rim alone."""
_DEPTH = 0.6
"""Lens radii in front of the plane and behind it within which a part is a lens; temples are farther off."""
_LARGEST = 2.0
"""Lens radii within which one lens lies; a pane for both eyes, or a frame, reaches farther."""
_AT_RIM = 0.25
"""Lens radii between a rim's key points and its surface, at most."""
_ENOUGH = 0.75
"""Share of the places at which a lens is met; what crosses fewer is a strut or a nose pad."""
_LONGEST_GAP_RAD = np.deg2rad(30.0)
"""Wider gaps are not holes in a scan but an open rim, which a straight line would cut off."""
_FLAT = 0.05
"""Spread of rim points across their longest direction below which they are a line and hold no plane."""
_REACH, _HEIGHTS = 0.16, 33
"""Heights looked at over and under the plane, in lens radii: a curved rim leaves the plane by about 0.1."""
_REFINEMENTS, _FINER = (0.006, 0.002), 9
"""Then heights around the neighbourhood's: single rays meet ends of bridges that poke through."""
_INNER, _OUTER = 0.4, 1.5
"""Hits outside this range, in lens radii, are a nose pad, the other rim or a temple."""
_WINDOW_RAD = 0.2
_DENT = 0.0025
"""Part of the radius by which the edge may lie inside a chord between its neighbours."""
_STEP = 0.05
"""Lens radii between neighbouring hits that part two surfaces, such as the outer wall seen in a cut tube."""
_JUMP = 0.12
"""Hits this much off the median of their neighbourhood, in lens radii, are something in the way."""
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


def pane_faces(
    vertices: FloatArray, faces: IntArray, plane: LensPlane, rim_points: FloatArray | None
) -> BoolArray:
    """Return (F,) True for the faces of parts that lie across the lens's axis, never all of them.

    A lens of one piece with the rim is none. Without rim points (K, 3) a small lens is guessed from the
    mesh's size.
    """
    if rim_points is None:
        radius = _GUESS * float(np.ptp(vertices[faces.ravel()], axis=0).max())
    else:
        radius = float(plane.profile(rim_points).radius.mean())
    part = vertex_components(len(vertices), faces)[faces[:, 0]]
    kept = np.ones(len(faces), bool)
    while kept.any():
        left = np.flatnonzero(kept)
        met = _met(vertices, faces[left], plane, radius)
        numbers, counts = np.unique(part[left[met[met >= 0]]], return_counts=True)
        panes = np.isin(part, numbers[counts >= _ENOUGH * len(met)]) & kept
        rest = kept & ~panes
        if not panes.any() or not rest.any():
            break
        if rim_points is not None:
            # The frame itself is larger than one lens, and without it there is no rim.
            reach = np.linalg.norm(vertices[faces[panes].ravel()] - plane.center, axis=1).max()
            if reach > _LARGEST * radius:
                apart = ClosestPointQuery(vertices, faces[rest]).query(rim_points).distance
                if (apart > _AT_RIM * radius).mean() > 0.5:
                    break
        kept = rest
    return ~kept


def is_covered(vertices: FloatArray, faces: IntArray, plane: LensPlane, rim_points: FloatArray) -> bool:
    """Return whether a surface, joined to the rim or not, fills most of the lens's opening."""
    met = _met(vertices, faces, plane, float(plane.profile(rim_points).radius.mean()))
    return bool((met >= 0).mean() >= _ENOUGH)


def _met(vertices: FloatArray, faces: IntArray, plane: LensPlane, radius: float) -> IntArray:
    """Return the face that is met at each of some places of the lens, -1 for none near it."""
    angles = np.linspace(-np.pi, np.pi, _PLACES, endpoint=False)
    places = plane.center + _INNER * radius * np.vstack([np.zeros(3), plane.directions(angles)])
    hits = RayCaster(vertices, faces).first_hit(places + _DEPTH * radius * plane.normal, -plane.normal)
    return np.where(hits.distance < 2 * _DEPTH * radius, hits.face, -1)


@dataclass(frozen=True)
class LensRim:
    """The inner edge of a rim."""

    points: FloatArray
    """(R, 3) at even angles around the centre, counterclockwise seen from the viewer; in the frame's unit."""
    measured: BoolArray
    """(R,) True where a ray hit the rim; the others are filled in."""
    gaps: Literal["none", "interpolated", "subdivided"]
    """How gaps were filled: from the rim on both sides, or by subdivision of the rim's key points."""
    center: FloatArray
    """(3,)"""
    normal: FloatArray
    """(3,) unit, towards the viewer."""


def find_lens_rim(
    vertices: ArrayLike,
    faces: ArrayLike,
    center: ArrayLike,
    *,
    rim_points: ArrayLike | None = None,
    normal: ArrayLike | None = None,
) -> LensRim:
    """Return the inner edge of the rim around a lens centre.

    Rays from the axis outward meet the rim's inner edge. Gaps of up to 30 degrees are bridged between their
    ends; wider ones, such as the open side of a half-rimless frame, take their shape from the rim's key
    points, shifted so that it joins what was measured. Lenses that are parts of their own are looked
    through.

    Parameters
    ----------
    vertices : (V, 3) array_like of float
        The frame; any unit, any number of parts, any winding.
    faces : (F, 3) array_like of int
    center : (3,) array_like of float
        Inside the rim, about in the lens plane.
    rim_points : (K, 3) array_like of float, optional
        Three or more key points on or at the rim, in any order.
    normal : (3,) array_like of float, optional
        Of the lens plane to some degrees, towards the viewer. Otherwise of the plane nearest to the rim
        points, away from the temples.

    Raises
    ------
    EyeglassesError
        When the mesh is empty or not finite, neither rim points nor a normal are given, or too little of
        a rim lies around the centre to do without rim points.
    ValueError
        When an array has the wrong shape.

    Notes
    -----
    MEGANE's supplement subdivides from the key points throughout, which stops a tube's radius off the inner
    edge; here that is the fallback. Cost: some 85 rays a point.

    Examples
    --------
    >>> from scan2albedo.synthetic import eyeglasses
    >>> frame = eyeglasses(seed=1)
    >>> left = [i for i, name in enumerate(frame.names) if name.startswith("left_rim")]
    >>> rim = find_lens_rim(
    ...     frame.vertices, frame.faces, frame.lens_centers[0], rim_points=frame.keypoints[left])
    >>> rim.points.shape, rim.gaps
    ((128, 3), 'none')
    """
    xyz, index = checked_mesh(vertices, faces, "the frame")
    middle = _checked_vector("center", center)
    marks = None if rim_points is None else checked_points("rim_points", rim_points)
    if normal is not None:
        axis = _checked_vector("normal", normal)
    elif marks is None:
        raise EyeglassesError("a lens plane needs rim_points, three or more around the lens, or a normal")
    else:
        axis = fit_normal(marks, xyz)
    plane = LensPlane.at(middle, axis)
    angles = np.linspace(-np.pi, np.pi, _POINTS, endpoint=False)
    lens_radius = None if marks is None else float(plane.profile(marks).radius.mean())
    # A domed lens would stop the rays before they reach the rim.
    rims = index[~pane_faces(xyz, index, plane, marks)]
    shot = shoot_rim(RayCaster(xyz, rims), plane, angles, lens_radius)
    measured = np.isfinite(shot.radius)
    gaps: Literal["none", "interpolated", "subdivided"] = "none"
    if not measured.all():
        hits = np.flatnonzero(measured)
        runs = np.diff(np.append(hits, hits[:1] + _POINTS)) - 1
        small = len(hits) > 0 and runs.max() * 2 * np.pi / _POINTS <= _LONGEST_GAP_RAD
        if not small and marks is None:
            raise EyeglassesError(
                f"no closed rim around the centre {middle.round(2).tolist()}: {(~measured).sum()} of "
                f"{_POINTS} rays meet nothing near; give rim_points, or check centre and normal"
            )
        gaps, base = "interpolated", RimProfile(np.zeros(_POINTS), np.zeros(_POINTS))
        if not small and marks is not None:
            gaps, base = "subdivided", subdivide_rim(xyz, plane, marks, angles)
        # Gaps get the outline's shape, joined to what was measured at both their ends.
        filled = []
        for values, shape in ((shot.radius, base.radius), (shot.height, base.height)):
            if measured.any():
                rest = np.interp(angles, angles[measured], (values - shape)[measured], period=2 * np.pi)
                shape = np.where(measured, values, shape + rest)
            filled.append(shape)
        shot = RimProfile(*filled)
    return LensRim(plane.points(angles, shot), measured, gaps, middle, plane.normal)


def _checked_vector(name: str, values: ArrayLike) -> FloatArray:
    vector = np.asarray(values, np.float64)
    if vector.shape != (3,):
        raise ValueError(f"{name} must have shape (3,), got {vector.shape}")
    if not np.isfinite(vector).all():
        raise EyeglassesError(f"{name} holds numbers that are not finite; repair the input first")
    return vector


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
    known = np.isfinite(radius)
    if known.sum() >= len(angles) / 2:
        basis = np.stack([np.ones(len(angles)), np.cos(angles), np.sin(angles)], 1)
        level = basis @ np.linalg.lstsq(basis[known], height[known], rcond=None)[0]
    radius, height = _nearest(caster, plane, angles, level, lens_radius, _REACH, _HEIGHTS)
    for reach in _REFINEMENTS:
        level = _local_median(height, np.isfinite(radius))
        radius, height = _nearest(caster, plane, angles, level, lens_radius, reach, _FINER)
    found = np.isfinite(radius)
    found &= ~(np.abs(radius - _local_median(radius, found)) > _JUMP * lens_radius)
    found &= ~_stray(np.where(found, radius / lens_radius, np.nan))
    # The ray beside a gap may have met the cut instead of the edge.
    found &= np.roll(found, 1) & np.roll(found, -1)
    # Rims are convex over a short way: ends of bridges and solder poke through chords between neighbours.
    outline = np.where(found, radius, np.nan)
    for k in range(1, _half_window(len(angles)) + 1):
        before, after = np.roll(outline, k), np.roll(outline, -k)
        chord = 2 * before * after * np.cos(2 * np.pi * k / len(angles)) / (before + after)
        found &= ~(outline < (1 - _DENT) * chord)
    return RimProfile(np.where(found, radius, np.nan), np.where(found, height, np.nan))


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
    distance[(distance < _INNER * lens_radius) | (distance > _OUTER * lens_radius)] = np.inf
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
    for _ in range(5):
        following = np.roll(outline, -1, 0)
        middle = (9 * (outline + following) - np.roll(outline, 1, 0) - np.roll(outline, -2, 0)) / 16
        distance, nearest = tree.query(middle)
        pulled = distance <= _PULL * np.linalg.norm(following - outline, axis=1)
        middle[pulled] = vertices[nearest[pulled]]
        outline = np.stack([outline, middle], 1).reshape(-1, 3)
        # Two middles drawn to one vertex would leave an edge without length.
        outline = outline[np.linalg.norm(outline - np.roll(outline, 1, 0), axis=1) > 0]
    at, own = plane.angles(outline), plane.profile(outline)
    return RimProfile(
        np.interp(angles, at, own.radius, period=2 * np.pi),
        np.interp(angles, at, own.height, period=2 * np.pi),
    )
