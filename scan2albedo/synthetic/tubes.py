"""Closed and open tubes: rings of points joined to a surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scan2albedo.geometry.mesh import normalized

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


def ring_faces(rings: IntArray) -> IntArray:
    """Return the (F, 3) triangles between consecutive rings of vertex numbers (R, S).

    Seen along the tube, rings run clockwise when the normals are to point outward.
    """
    a, c = rings[:-1], rings[1:]
    b, d = np.roll(a, -1, 1), np.roll(c, -1, 1)
    return np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([b, d, c], -1).reshape(-1, 3)])


def cap_faces(ring: IntArray, center: int, *, end: bool) -> IntArray:
    """Return the fan (S, 3) that closes the first (or last, `end`) ring (S,) of a tube."""
    after = np.roll(ring, -1)
    fan = np.stack([ring, after, np.full(len(ring), center)], 1)
    return fan if end else fan[:, ::-1]


def path_frames(path: FloatArray, up: FloatArray) -> FloatArray:
    """Return (R, 3, 3) rows tangent, tangent x up, up along a path (R, 3) that never runs along `up`."""
    tangent = normalized(np.gradient(path, axis=0))
    across = normalized(np.cross(tangent, up))
    return np.stack([tangent, across, np.cross(across, tangent)], 1)


def ellipse_offsets(count: int, across: float, up: float, first_angle_rad: float) -> FloatArray:
    """Return (count, 3) offsets in (tangent, across, up), clockwise along the tangent."""
    angle = first_angle_rad - 2 * np.pi * np.arange(count) / count
    return np.stack([np.zeros(count), across * np.cos(angle), up * np.sin(angle)], 1)
