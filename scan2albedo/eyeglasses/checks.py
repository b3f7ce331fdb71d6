"""Checks of arrays that callers give."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.keypoints import KEY_POINT_COUNT


def checked_points(name: str, values: ArrayLike) -> FloatArray:
    """Return finite points (N, 3), N >= 1, as float64.

    Raises EyeglassesError when there is none or numbers are not finite, ValueError for another shape.
    """
    points = np.ascontiguousarray(values, np.float64)
    if points.size == 0:
        raise EyeglassesError(f"{name} hold nothing; give one or more")
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"{name} must have shape (N, 3), got {points.shape}")
    bad = np.flatnonzero(~np.isfinite(points).all(1))
    if len(bad):
        raise EyeglassesError(
            f"{name}[{bad[0]}] is not finite: {points[bad[0]].tolist()} ({len(bad)} of {len(points)} "
            "are not); repair the input first"
        )
    return points


def checked_mesh(vertices: ArrayLike, faces: ArrayLike, owner: str = "") -> tuple[FloatArray, IntArray]:
    """Return vertices (V, 3) and faces (F, 3) of a mesh with faces; messages begin with its `owner`.

    Raises EyeglassesError when it is empty or not finite, ValueError when arrays do not fit together.
    """
    of = f"{owner}: " if owner else ""
    xyz, index = checked_points(f"{of}vertices", vertices), np.asarray(faces)
    if index.size == 0:
        raise EyeglassesError(f"{of}no faces; give a mesh with faces")
    if index.ndim != 2 or index.shape[1] != 3:
        raise ValueError(f"{of}faces must have shape (F, 3), got {index.shape}")
    if not np.issubdtype(index.dtype, np.integer):
        raise ValueError(f"{of}faces must hold integers, got {index.dtype}")
    if index.min() < 0 or index.max() >= len(xyz):
        raise ValueError(f"{of}faces must hold 0 to {len(xyz) - 1}, got {index.min()} to {index.max()}")
    return xyz, np.ascontiguousarray(index, np.int64)


def checked_keypoints(name: str, values: ArrayLike) -> FloatArray:
    """Return key points (20, 3) as a new array; raises ValueError for another shape."""
    points = np.array(values, np.float64)
    if points.shape != (KEY_POINT_COUNT, 3):
        raise ValueError(
            f"{name} must have shape ({KEY_POINT_COUNT}, 3), got {points.shape}; NaN rows for missing ones"
        )
    return points


def checked_weights(name: str, values: ArrayLike, count: int) -> FloatArray:
    """Return weights (V, 20) of `count` vertices; raises ValueError for another shape."""
    weights = np.ascontiguousarray(values, np.float64)
    if weights.shape != (count, KEY_POINT_COUNT):
        raise ValueError(f"{name} must have shape ({count}, {KEY_POINT_COUNT}), got {weights.shape}")
    return weights
