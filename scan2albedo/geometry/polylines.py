"""Points of the plane beside polylines and inside polygons."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from scan2albedo.core.arrays import BoolArray, FloatArray


def polyline_distance(points: FloatArray, line: FloatArray) -> FloatArray:
    """Return the distances (N,) of points (N, 2) from a polyline (K, 2).

    >>> import numpy as np
    >>> polyline_distance(np.array([[1.0, 2.0], [5.0, 0.0]]), np.array([[0.0, 0.0], [2.0, 0.0]]))
    array([2., 3.])
    """
    nearest = np.full(len(points), np.inf)
    for start, end in pairwise(line):
        offset, along = points - start, end - start
        part = np.clip(offset @ along / max(float(along @ along), 1e-12), 0, 1)
        nearest = np.minimum(nearest, np.linalg.norm(offset - part[:, None] * along, axis=1))
    return nearest


def inside_polygon(points: FloatArray, corners: FloatArray) -> BoolArray:
    """Return (N,) which points (N, 2) lie in a polygon (K, 2), by how often a ray crosses its border.

    >>> import numpy as np
    >>> inside_polygon(np.array([[1.0, 1.0], [3.0, 1.0]]), np.array([[0, 0], [2, 0], [2, 2], [0, 2.0]]))
    array([ True, False])
    """
    x, y = points.T
    inside = np.zeros(len(points), bool)
    for (ax, ay), (bx, by) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if ay != by:
            inside ^= ((ay > y) != (by > y)) & (x < (bx - ax) * (y - ay) / (by - ay) + ax)
    return inside
