"""Vertices that a scanner threw far away, which would swell every box and moment."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_NEAR_PERCENT = 98.0
_STRAY_FACTOR = 4.0


def without_stray(vertices: FloatArray, faces: IntArray) -> IntArray:
    """Return the faces (K, 3) that keep near the rest of the surface.

    A face goes when a corner of it lies more than 4 times as far from the vertices' median as 98 % of them
    do; so at most 2 % of the vertices can stray.

    Parameters
    ----------
    vertices : (V, 3) float64
    faces : (F, 3) int64
    """
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    distance = np.linalg.norm(vertices - np.median(vertices[used], axis=0), axis=1)
    stray = distance > _STRAY_FACTOR * np.percentile(distance[used], _NEAR_PERCENT)
    return faces[~stray[faces].any(1)] if (stray & used).any() else faces
