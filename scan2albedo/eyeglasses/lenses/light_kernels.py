"""Compiled loops over points and distant lights; shading as in `lighting.kernels`."""

from __future__ import annotations

import numpy as np
from numba import njit

from scan2albedo.lighting.kernels import oren_nayar_coefficients

DARK, WAITING, AWAY = 0, 254, 255
"""Ways of light: none, not known yet, from behind. All others are 1 + the sum of 2^j of lenses passed."""


@njit(cache=True, nogil=True, error_model="numpy")
def seen_normals(directions, face, barycentric, vertices, faces, normals, least):  # type: ignore[no-untyped-def]
    """Return (N, 3) unit normals on the viewer's side where rays along `directions` meet faces.

    Smooth ones, from the `normals` (V, 3) of vertices; the face's own where the cosine between the two is not
    above `least`.
    """
    result = np.empty((len(face), 3))
    flat, smooth = np.empty(3), np.empty(3)
    for i in range(len(face)):
        a, b, c = faces[face[i]]
        length = size = facing = agreement = 0.0
        for k in range(3):
            m, n = (k + 1) % 3, (k + 2) % 3
            flat[k] = (vertices[b, m] - vertices[a, m]) * (vertices[c, n] - vertices[a, n]) - (
                vertices[b, n] - vertices[a, n]
            ) * (vertices[c, m] - vertices[a, m])
            smooth[k] = (
                barycentric[i, 0] * normals[a, k]
                + barycentric[i, 1] * normals[b, k]
                + barycentric[i, 2] * normals[c, k]
            )
            length += flat[k] * flat[k]
            size += smooth[k] * smooth[k]
            facing += flat[k] * directions[i, k]
            agreement += flat[k] * smooth[k]
        length, size = np.sqrt(length), np.sqrt(size)
        side = -1.0 if facing > 0.0 else 1.0
        if length * size > 0.0 and abs(agreement) > least * length * size:
            turn = side if agreement > 0.0 else -side
            for k in range(3):
                result[i, k] = turn * smooth[k] / size
        else:
            for k in range(3):
                result[i, k] = side * flat[k] / length if length > 0.0 else 0.0
    return result


@njit(cache=True, nogil=True)
def mark_facing(normal, toward, paths):  # type: ignore[no-untyped-def]
    """Set `paths` (N, K) to WAITING where a light is in front of the surface, to AWAY elsewhere."""
    for i in range(normal.shape[0]):
        for k in range(toward.shape[0]):
            cosine = 0.0
            for c in range(3):
                cosine += normal[i, c] * toward[k, c]
            paths[i, k] = WAITING if cosine > 0.0 else AWAY


@njit(cache=True, nogil=True)
def copy_from_neighbours(point, near, paths):  # type: ignore[no-untyped-def]
    """Take over what is WAITING at `point` (M,) from `near` (M, 4) where these agree and face the light."""
    for m in range(len(point)):
        i, a, b, c, d = point[m], near[m, 0], near[m, 1], near[m, 2], near[m, 3]
        if a < 0:
            continue
        for k in range(paths.shape[1]):
            way = paths[a, k]
            agreed = way == paths[b, k] and way == paths[c, k] and way == paths[d, k]
            if agreed and way < WAITING and paths[i, k] == WAITING:
                paths[i, k] = way


@njit(cache=True, nogil=True)
def waiting_rays(paths, point, start, toward, low, high, origin, heading, place):  # type: ignore[no-untyped-def]
    """Collect rays from `start` (N, 3) whose path to `point` (M,) of lights `low` to `high` is WAITING.

    Returns how many; their origins, directions and places (i, k) are written to the last three arguments.
    """
    count = 0
    for k in range(low, high):
        for m in range(len(point)):
            i = point[m]
            if paths[i, k] == WAITING:
                for c in range(3):
                    origin[count, c] = start[i, c]
                    heading[count, c] = toward[k, c]
                place[count, 0], place[count, 1] = i, k
                count += 1
    return count


@njit(cache=True, nogil=True)
def lens_rays(paths, position, local, center, radius, toward, low, high, origin, heading, place):  # type: ignore[no-untyped-def]
    """Collect rays as `waiting_rays` does, of open paths that pass a ball around a lens."""
    count = 0
    for k in range(low, high):
        for i in range(position.shape[0]):
            way = paths[i, k]
            if way == DARK or way >= WAITING:
                continue
            along = distance = 0.0
            for c in range(3):
                offset = center[c] - position[i, c]
                along += offset * toward[k, c]
                distance += offset * offset
            if along < -radius or distance - along * along > radius * radius:
                continue
            for c in range(3):
                origin[count, c] = local[i, c]
                heading[count, c] = toward[k, c]
            place[count, 0], place[count, 1] = i, k
            count += 1
    return count


@njit(cache=True, nogil=True)
def set_paths(paths, place, occluded, hit, free):  # type: ignore[no-untyped-def]
    """Add `hit` to the paths at places (M, 2) that are occluded (M,), `free` to the others."""
    for m in range(len(occluded)):
        i, k = place[m]
        paths[i, k] += hit if occluded[m] else free


@njit(cache=True, nogil=True, error_model="numpy")
def shade(  # type: ignore[no-untyped-def]
    normal, viewer, albedo, surface, gloss, paths, passed, toward, irradiance, bare, shaded
):
    """Sum E (albedo f_d / pi + specular f_s) over lights into `bare` and `shaded` (N, 3).

    Of points with unit normal, direction to the viewer and albedo (N, 3), each with a `surface` (N,), its row
    in `gloss` (S, 3): sigma of Oren and Nayar in radians, strength and exponent of Phong's highlight.
    `paths` (N, K) are those of `light_paths`; `passed` (P, 3) is the share of light for each way through
    lenses, 1 for the first, without any, and counts in `shaded`. Lights: unit directions `toward` and
    irradiance E (K, 3).
    """
    matte, lost, glossy, lost_glossy = np.empty((4, 3))
    for i in range(normal.shape[0]):
        sigma, specular, exponent = gloss[surface[i]]
        a, b = oren_nayar_coefficients(sigma)
        n_v = normal[i, 0] * viewer[i, 0] + normal[i, 1] * viewer[i, 1] + normal[i, 2] * viewer[i, 2]
        cos_r = max(n_v, 0.0)
        matte[:], lost[:], glossy[:], lost_glossy[:] = 0.0, 0.0, 0.0, 0.0
        for k in range(toward.shape[0]):
            way = paths[i, k]
            if way == DARK or way >= WAITING:
                continue
            n_l = l_v = 0.0
            for c in range(3):
                n_l += normal[i, c] * toward[k, c]
                l_v += viewer[i, c] * toward[k, c]
            f_d = n_l
            if sigma > 0.0:
                f_d *= a + b * max(l_v - n_l * cos_r, 0.0) / max(max(n_l, cos_r), 1e-4)
            f_s, r_v = 0.0, 2.0 * n_l * n_v - l_v
            if specular > 0.0 and r_v > 0.0:
                f_s = specular * min(r_v, 1.0) ** exponent
            for c in range(3):
                matte[c] += irradiance[k, c] * f_d
                glossy[c] += irradiance[k, c] * f_s
                if way > 1:
                    taken = irradiance[k, c] * (1.0 - passed[way - 1, c])
                    lost[c] += taken * f_d
                    lost_glossy[c] += taken * f_s
        for c in range(3):
            reflectance = albedo[i, c] / np.pi
            bare[i, c] = reflectance * matte[c] + glossy[c]
            shaded[i, c] = bare[i, c] - (reflectance * lost[c] + lost_glossy[c])
