"""Lenses that a frame's mesh holds already: parts that lie across a lens's axis."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scan2albedo.eyeglasses.lenses.lens_plane import LensPlane
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import vertex_components
from scan2albedo.geometry.rays import RayCaster

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

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


def without_panes(
    vertices: FloatArray, faces: IntArray, plane: LensPlane, rim_points: FloatArray | None
) -> IntArray:
    """Return the faces (F', 3) of the parts that do not lie across the lens's axis.

    A ray in the plane meets a domed lens long before the rim. A lens of one piece with the rim stays. Without
    rim points (K, 3) a small lens is guessed from the mesh's size.
    """
    return faces[~pane_faces(vertices, faces, plane, rim_points)]


def pane_faces(
    vertices: FloatArray, faces: IntArray, plane: LensPlane, rim_points: FloatArray | None
) -> BoolArray:
    """Return (F,) True for the faces of parts that lie across the lens's axis, never all of them."""
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
    """Return whether something, of one piece with the rim or not, lies across the lens's axis."""
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
