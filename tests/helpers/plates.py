"""Flat squares across the z axis, as surfaces that lenses show."""

import numpy as np

from scan2albedo.eyeglasses import Surface

CORNERS = np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
FACES = np.array([[0, 1, 2], [0, 2, 3]])


def plate(half, z, **finish):
    """Return a square at height `z` that looks along +z and reaches `half` to each side of the axis."""
    return Surface(np.column_stack([half * CORNERS, np.full(4, z)]), FACES, **finish)
