"""The inner rim of a frame around a lens centre."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.checks import checked_mesh, checked_points
from scan2albedo.eyeglasses.lenses.rim_outline import (
    LensPlane,
    RimProfile,
    fit_normal,
    shoot_rim,
    subdivide_rim,
)
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import vertex_components
from scan2albedo.geometry.rays import RayCaster

_PLACES = 12
_INNER = 0.4
"""Parts are looked for on a circle of this many lens radii around the centre, and at the centre."""
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
_FEWEST = 32
"""Points of a rim; with fewer, neighbours are too far apart to tell the rim from what is in the way."""
_LONGEST_GAP_DEG = 30.0
"""Wider gaps are no hole in a scan but an open rim, which a straight line would cut off."""


def pane_faces(
    vertices: FloatArray, faces: IntArray, plane: LensPlane, rim_points: FloatArray | None
) -> BoolArray:
    """Return (F,) True for the faces of parts that lie across the lens's axis, never all of them.

    A lens of one piece with the rim is none. Without rim points (K, 3) a small lens is guessed from the
    mesh's size.
    """
    radius = _radius(vertices, faces, plane, rim_points)
    part = vertex_components(len(vertices), faces)[faces[:, 0]]
    kept = np.ones(len(faces), bool)
    while kept.any():
        left = np.flatnonzero(kept)
        met = _met(vertices, faces[left], plane, radius)
        numbers, counts = np.unique(part[left[met[met >= 0]]], return_counts=True)
        panes = np.isin(part, numbers[counts >= _ENOUGH * len(met)]) & kept
        if not panes.any() or not (kept & ~panes).any():
            break
        if rim_points is not None and _is_frame(vertices, faces, panes, kept & ~panes, plane, rim_points):
            break
        kept &= ~panes
    return ~kept


def is_covered(vertices: FloatArray, faces: IntArray, plane: LensPlane, rim_points: FloatArray) -> bool:
    """Return whether a surface, joined to the rim or not, fills most of the lens's opening."""
    met = _met(vertices, faces, plane, _radius(vertices, faces, plane, rim_points))
    return bool((met >= 0).mean() >= _ENOUGH)


def _radius(vertices: FloatArray, faces: IntArray, plane: LensPlane, rim_points: FloatArray | None) -> float:
    if rim_points is not None:
        return float(plane.profile(rim_points).radius.mean())
    return _GUESS * float(np.ptp(vertices[faces.ravel()], axis=0).max())


def _met(vertices: FloatArray, faces: IntArray, plane: LensPlane, radius: float) -> IntArray:
    """Return the face that is met at each of some places of the lens, -1 for none near it."""
    angles = np.linspace(-np.pi, np.pi, _PLACES, endpoint=False)
    places = plane.center + _INNER * radius * np.vstack([np.zeros(3), plane.directions(angles)])
    hits = RayCaster(vertices, faces).first_hit(places + _DEPTH * radius * plane.normal, -plane.normal)
    return np.where(hits.distance < 2 * _DEPTH * radius, hits.face, -1)


def _is_frame(
    vertices: FloatArray,
    faces: IntArray,
    panes: BoolArray,
    rest: BoolArray,
    plane: LensPlane,
    rim_points: FloatArray,
) -> bool:
    """Return whether panes are the frame itself: larger than one lens, and without them there is no rim."""
    radius = _radius(vertices, faces, plane, rim_points)
    reach = np.linalg.norm(vertices[faces[panes].ravel()] - plane.center, axis=1).max()
    if reach <= _LARGEST * radius:
        return False
    apart = ClosestPointQuery(vertices, faces[rest]).query(rim_points).distance
    return bool((apart > _AT_RIM * radius).mean() > 0.5)


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
    count: int = 128,
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
    count : int
        Points of the rim.

    Raises
    ------
    EyeglassesError
        When the mesh is empty or not finite, neither rim points nor a normal are given, or too little of
        a rim lies around the centre to do without rim points.
    ValueError
        When an array has the wrong shape or `count` is less than 32.

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
    if count < _FEWEST:
        raise ValueError(f"count must be {_FEWEST} or more, got {count}")
    plane = _plane(xyz, middle, marks, normal)
    angles = np.linspace(-np.pi, np.pi, count, endpoint=False)
    lens_radius = None if marks is None else float(plane.profile(marks).radius.mean())
    # A domed lens would stop the rays before they reach the rim.
    rims = index[~pane_faces(xyz, index, plane, marks)]
    shot = shoot_rim(RayCaster(xyz, rims), plane, angles, lens_radius)
    measured = np.isfinite(shot.radius)
    gaps: Literal["none", "interpolated", "subdivided"] = "none"
    if not measured.all():
        few = np.rad2deg(_longest_gap(measured)) <= _LONGEST_GAP_DEG
        if not few and marks is None:
            raise EyeglassesError(
                f"no closed rim around the centre {middle.round(2).tolist()}: {(~measured).sum()} of {count} "
                "rays meet nothing near; give rim_points, or check centre and normal"
            )
        gaps = "interpolated" if few or marks is None else "subdivided"
        outline = None if few or marks is None else subdivide_rim(xyz, plane, marks, angles)
        shot = _filled(shot, measured, outline, angles)
    return LensRim(plane.points(angles, shot), measured, gaps, middle, plane.normal)


def _plane(
    vertices: FloatArray, center: FloatArray, rim_points: FloatArray | None, normal: ArrayLike | None
) -> LensPlane:
    if normal is not None:
        return LensPlane.at(center, _checked_vector("normal", normal))
    if rim_points is None:
        raise EyeglassesError("a lens plane needs rim_points, three or more around the lens, or a normal")
    return LensPlane.at(center, fit_normal(rim_points, vertices))


def _longest_gap(measured: BoolArray) -> float:
    """Return the widest run of unmeasured angles in rad."""
    hits = np.flatnonzero(measured)
    if len(hits) == 0:
        return 2 * np.pi
    runs = np.diff(np.append(hits, hits[0] + len(measured))) - 1
    return float(runs.max()) * 2 * np.pi / len(measured)


def _filled(
    shot: RimProfile, measured: BoolArray, outline: RimProfile | None, angles: FloatArray
) -> RimProfile:
    """Return the profile with gaps given the outline's shape, or none, joined to both their ends."""
    zero = np.zeros(len(angles))
    base = outline if outline is not None else RimProfile(zero, zero)
    if not measured.any():
        return base

    def fill(values: FloatArray, shape: FloatArray) -> FloatArray:
        rest = np.interp(angles, angles[measured], (values - shape)[measured], period=2 * np.pi)
        return np.where(measured, values, shape + rest)

    return RimProfile(fill(shot.radius, base.radius), fill(shot.height, base.height))


def _checked_vector(name: str, values: ArrayLike) -> FloatArray:
    vector = np.asarray(values, np.float64)
    if vector.shape != (3,):
        raise ValueError(f"{name} must have shape (3,), got {vector.shape}")
    if not np.isfinite(vector).all():
        raise EyeglassesError(f"{name} holds numbers that are not finite; repair the input first")
    return vector
