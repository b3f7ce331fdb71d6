"""A rim from its key points alone, by subdivision towards the closest vertices."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scan2albedo.eyeglasses.lenses.lens_plane import LensPlane, RimProfile

FloatArray = NDArray[np.float64]

_LEVELS = 5
_PULL = 0.25
"""Part of an edge's length within which a vertex draws its middle: farther off is another piece of frame."""


def subdivide_rim(
    vertices: FloatArray, plane: LensPlane, rim_points: FloatArray, angles: FloatArray
) -> RimProfile:
    """Return an outline through rim points (K, 3), K >= 3, at ascending angles (R,).

    Each level puts a point into the middle of every edge, by the four-point rule
    (9 (b + c) - a - d) / 16 [1]_, and moves it to the closest vertex of the frame if there is one near.
    Where the frame is open the curve stays round.

    Notes
    -----
    It ends on whichever side of the rim's tube the vertices lie, the outer edge too: up to 4.5 mm off on
    synthetic frames. Rays are better wherever they hit.

    References
    ----------
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
    """Return the outline at the angles asked for, seen from the centre."""
    at, own = plane.angles(outline), plane.profile(outline)
    return RimProfile(
        np.interp(angles, at, own.radius, period=2 * np.pi),
        np.interp(angles, at, own.height, period=2 * np.pi),
    )
