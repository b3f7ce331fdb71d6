"""Compiled inner loops of the fit."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def surface_normals(points, faces):  # type: ignore[no-untyped-def]
    """Return (N, 3) unit vertex normals and (F, 3) unit face normals; zero where there is no area."""
    vertex, face = np.zeros((len(points), 3)), np.zeros((len(faces), 3))
    for f in range(len(faces)):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, az = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]
        bx, by, bz = points[k, 0] - points[i, 0], points[k, 1] - points[i, 1], points[k, 2] - points[i, 2]
        x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        for v in (i, j, k):
            vertex[v, 0] += x
            vertex[v, 1] += y
            vertex[v, 2] += z
        length = np.sqrt(x * x + y * y + z * z)
        if length > 0:
            face[f, 0], face[f, 1], face[f, 2] = x / length, y / length, z / length
    for v in range(len(vertex)):
        length = np.sqrt(vertex[v, 0] ** 2 + vertex[v, 1] ** 2 + vertex[v, 2] ** 2)
        if length > 0:
            vertex[v] /= length
    return vertex, face


@njit(cache=True, nogil=True)
def turned_faces(normals, points, faces, min_cosine):  # type: ignore[no-untyped-def]
    """Return the indices of faces whose normal at `points` leaves unit `normals` (F, 3) by too much."""
    turned = np.zeros(len(faces), np.bool_)
    for f in range(len(faces)):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, az = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]
        bx, by, bz = points[k, 0] - points[i, 0], points[k, 1] - points[i, 1], points[k, 2] - points[i, 2]
        x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        nx, ny, nz = normals[f, 0], normals[f, 1], normals[f, 2]
        along = x * nx + y * ny + z * nz
        if nx != 0 or ny != 0 or nz != 0:
            turned[f] = along < min_cosine * np.sqrt(x * x + y * y + z * z)
    return np.flatnonzero(turned)
