"""Compiled inner loops of the fit."""

from __future__ import annotations

import numpy as np
from numba import njit

from scan2albedo.geometry.nearest_surface import nearest_around, walk_downhill


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


@njit(cache=True, nogil=True)
def pulled(points, vertex, xyz, faces, ring, ring_start, near, near_start, normals, boundary):  # type: ignore[no-untyped-def]
    """Return for each point (N, 3) what the scan surface nearest to it says.

    `vertex` (N,) is walked downhill in place. Returned are the offset (N, 3) to the closest point, the
    unit normal (N, 3) there, the distance (N,), and whether the closest point lies on the border (N,).
    """
    count = len(points)
    offset, normal = np.empty((count, 3)), np.empty((count, 3))
    distance, border = np.empty(count), np.empty(count, np.bool_)
    for i in range(count):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        v = walk_downhill(x, y, z, vertex[i], xyz, near, near_start)
        vertex[i] = v
        best, nearest, k0, k1, k2, px, py, pz = nearest_around(x, y, z, v, xyz, faces, ring, ring_start)
        offset[i, 0], offset[i, 1], offset[i, 2] = px, py, pz
        distance[i] = np.sqrt(best)
        a, b, c = faces[nearest, 0], faces[nearest, 1], faces[nearest, 2]
        nx = k0 * normals[a, 0] + k1 * normals[b, 0] + k2 * normals[c, 0]
        ny = k0 * normals[a, 1] + k1 * normals[b, 1] + k2 * normals[c, 1]
        nz = k0 * normals[a, 2] + k1 * normals[b, 2] + k2 * normals[c, 2]
        size = max(np.sqrt(nx * nx + ny * ny + nz * nz), 1e-300)
        normal[i, 0], normal[i, 1], normal[i, 2] = nx / size, ny / size, nz / size
        border[i] = k0 * boundary[a] + k1 * boundary[b] + k2 * boundary[c] > 0.999
    return offset, normal, distance, border


@njit(cache=True, nogil=True)
def springs(offset, normal, across, along):  # type: ignore[no-untyped-def]
    """Return the forces (N, 3) H offset and the stiffness H = across n n^T + along I of N springs.

    H is given as (N, 6): xx, yy, zz, xy, xz, yz.
    """
    force, stiffness = np.empty((len(offset), 3)), np.empty((len(offset), 6))
    for i in range(len(offset)):
        x, y, z = normal[i, 0], normal[i, 1], normal[i, 2]
        pull = across[i] * (x * offset[i, 0] + y * offset[i, 1] + z * offset[i, 2])
        force[i, 0] = pull * x + along[i] * offset[i, 0]
        force[i, 1] = pull * y + along[i] * offset[i, 1]
        force[i, 2] = pull * z + along[i] * offset[i, 2]
        stiffness[i, 0] = across[i] * x * x + along[i]
        stiffness[i, 1] = across[i] * y * y + along[i]
        stiffness[i, 2] = across[i] * z * z + along[i]
        stiffness[i, 3] = across[i] * x * y
        stiffness[i, 4] = across[i] * x * z
        stiffness[i, 5] = across[i] * y * z
    return force, stiffness


@njit(cache=True, nogil=True)
def spring_product(x, start, column, value, stiffness):  # type: ignore[no-untyped-def]
    """Return S^T H S x for x (C, 3), S (N, C) in CSR form, H the stiffness (N, 6) of each sample."""
    result = np.zeros_like(x)
    for i in range(len(stiffness)):
        xx, yy, zz = stiffness[i, 0], stiffness[i, 1], stiffness[i, 2]
        if xx + yy + zz == 0.0:
            continue
        xy, xz, yz = stiffness[i, 3], stiffness[i, 4], stiffness[i, 5]
        px, py, pz = 0.0, 0.0, 0.0
        for r in range(start[i], start[i + 1]):
            c, s = column[r], value[r]
            px += s * x[c, 0]
            py += s * x[c, 1]
            pz += s * x[c, 2]
        qx, qy, qz = xx * px + xy * py + xz * pz, xy * px + yy * py + yz * pz, xz * px + yz * py + zz * pz
        for r in range(start[i], start[i + 1]):
            c, s = column[r], value[r]
            result[c, 0] += s * qx
            result[c, 1] += s * qy
            result[c, 2] += s * qz
    return result
