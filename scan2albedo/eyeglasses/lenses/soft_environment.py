"""A plain studio for pictures that are given no light of their own."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.pinhole import normalized_cameras, pixel_directions

FloatArray = NDArray[np.float64]

_LAMPS = (
    ((-0.6, 0.6, 0.7), 0.82, 7.0),
    ((0.9, 0.15, 0.6), 0.86, 1.6),
    ((0.15, 0.95, -0.45), 0.86, 3.0),
)
"""Direction (right, up, toward the camera), cosine of half the angle and radiance of each soft lamp: key,
fill, and one above the sitter."""
_SOFTNESS = 0.08
"""Cosines over which a lamp's edge fades."""


def soft_environment(camera: ArrayLike, shape: tuple[int, int], *, rows: int = 128) -> FloatArray:
    """Return a neutral map (rows, 2 rows, 3): an even room, brighter above, with three soft lamps.

    Parameters
    ----------
    camera : (3, 4) array_like of float
        Its picture's top is up, and the main lamp stands on its left.
    shape : (H, W)
        Of its picture.
    rows : int

    Examples
    --------
    >>> from scan2albedo.geometry.pinhole import look_at
    >>> room = soft_environment(look_at([0, 0, 600], [0, 0, 0], focal_px=100, shape=(9, 9)), (9, 9), rows=16)
    >>> room.shape, bool(room[:8].mean() > room[8:].mean())
    ((16, 32, 3), True)
    """
    azimuth = ((np.arange(2 * rows) + 0.5) / (2 * rows) - 0.5) * 2 * np.pi
    polar = ((np.arange(rows) + 0.5) * np.pi / rows)[:, None]
    toward = np.stack(
        np.broadcast_arrays(np.sin(polar) * np.sin(azimuth), np.cos(polar), np.sin(polar) * np.cos(azimuth)),
        -1,
    )
    seen = toward @ _axes(np.asarray(camera, np.float64), shape).T
    radiance = 0.4 + 0.2 * seen[..., 1]
    for direction, edge, strength in _LAMPS:
        rise = np.clip((seen @ normalized(np.array(direction)) - edge) / _SOFTNESS + 0.5, 0, 1)
        radiance = radiance + strength * rise * rise * (3 - 2 * rise)
    return np.repeat(radiance[..., None], 3, 2)


def _axes(camera: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Return rows right, up and toward the camera, unit vectors."""
    height, width = shape
    middle = np.array([(width - 1) / 2, (height - 1) / 2])
    # A step of one pixel, for the picture may be small and the focal length long.
    matrix = normalized_cameras(camera[None])[0]
    center, above = pixel_directions(matrix, np.array([middle, middle - [0, 1.0]]))
    up = normalized(above - (above @ center) * center)
    return np.array([np.cross(center, up), up, -center])
