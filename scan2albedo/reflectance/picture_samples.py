"""Pictures looked up at the vertices of a mesh."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from scan2albedo.errors import ReflectanceError
from scan2albedo.geometry.mesh import vertex_normals

FloatArray = NDArray[np.float64]

_UNIT = 1e-3
"""How far a normal's length may be from 1."""


def checked_mesh(vertices: ArrayLike, faces: ArrayLike) -> tuple[FloatArray, NDArray[np.int64]]:
    """Return vertices (V, 3) and faces (F, 3), or raise `ValueError` for other shapes."""
    xyz, index = np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.int64)
    if xyz.ndim != 2 or xyz.shape[1] != 3 or index.ndim != 2 or index.shape[1] != 3:
        raise ValueError(f"vertices is {xyz.shape} and faces {index.shape}, expected (V, 3) and (F, 3)")
    return xyz, index


def checked_normals(xyz: FloatArray, faces: NDArray[np.int64], normals: ArrayLike | None) -> FloatArray:
    """Return normals (V, 3) of a mesh, those given or its own; 0 where there are none.

    Raises
    ------
    ValueError
        When normals have another shape than the vertices.
    ReflectanceError
        When vertices or normals are not finite or not unit, or faces hold no triangles of the vertices.
    """
    if not np.isfinite(xyz).all():
        raise ReflectanceError("vertices are not all finite")
    if len(faces) == 0 or faces.min() < 0 or faces.max() >= len(xyz):
        raise ReflectanceError(f"faces hold no triangles, or others than of the {len(xyz)} vertices")
    if normals is None:
        return vertex_normals(xyz, faces)
    given = np.ascontiguousarray(normals, np.float64)
    if given.shape != xyz.shape:
        raise ValueError(f"normals is {given.shape}, expected {xyz.shape} as vertices")
    length = np.linalg.norm(given, axis=1)
    off = ~((np.abs(length - 1) < _UNIT) | (length == 0))
    if off.any():
        first = int(np.flatnonzero(off)[0])
        raise ReflectanceError(
            f"the normal of vertex {first} has length {length[first]:.4g}, expected 1 (or 0)"
        )
    return given


@njit(cache=True, nogil=True, error_model="numpy")
def bilinear_samples(picture, sigma, valid, pixels, usable, spread, value, variance, found):  # type: ignore[no-untyped-def]
    """Fill value, variance (V, 3) and found (V, 3) of the `usable` vertices at pixels (V, 2).

    `spread` is the variance of a vertex's position, px^2.
    """
    height, width = picture.shape[:2]
    for i in range(len(pixels)):
        x, y = pixels[i, 0], pixels[i, 1]
        if not usable[i] or not (0.0 <= x <= width - 1.0 and 0.0 <= y <= height - 1.0):
            continue
        left, top = min(int(x), max(width - 2, 0)), min(int(y), max(height - 2, 0))
        right, bottom = min(left + 1, width - 1), min(top + 1, height - 1)
        fx, fy = x - left, y - top
        for k in range(3):
            if not (
                valid[top, left, k]
                and valid[top, right, k]
                and valid[bottom, left, k]
                and valid[bottom, right, k]
            ):
                continue
            a, b, c, d = (1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy
            p, q = picture[top, left, k], picture[top, right, k]
            r, s = picture[bottom, left, k], picture[bottom, right, k]
            value[i, k] = a * p + b * q + c * r + d * s
            across, down = (q - p + s - r) / 2, (r - p + s - q) / 2
            # Each slope's own noise has this variance.
            noise = (
                sigma[top, left, k] ** 2
                + sigma[top, right, k] ** 2
                + sigma[bottom, left, k] ** 2
                + sigma[bottom, right, k] ** 2
            ) / 4
            variance[i, k] = (
                (a * sigma[top, left, k]) ** 2
                + (b * sigma[top, right, k]) ** 2
                + (c * sigma[bottom, left, k]) ** 2
                + (d * sigma[bottom, right, k]) ** 2
                + spread * max(across * across + down * down - 2 * noise, 0.0)
            )
            found[i, k] = True
