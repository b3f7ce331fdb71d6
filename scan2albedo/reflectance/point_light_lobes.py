"""Radiance of a vertex of unit albedo, and of unit weight of each lobe, under a point light."""

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from scan2albedo.core.arrays import FloatArray, checked_array
from scan2albedo.geometry.mesh import normalized
from scan2albedo.reflectance.vertex_reflectance import EXPONENTS, VertexReflectance

PEAKS = tuple((s + 2) / (8 * np.pi) for s in EXPONENTS)
"""Of the lobes: where h is the normal."""


def point_light_lobes(
    vertices: ArrayLike,
    normals: ArrayLike,
    camera_positions: ArrayLike,
    light_positions: ArrayLike,
    *,
    reference_distance_mm: float | None = None,
) -> FloatArray:
    """Return (J, V, 4): max(0, n.l) / pi and (s + 2) / (8 pi) max(0, n.h)^s for s = 1, 8, 64.

    As in the released code of Han, Wang and Xu, lobes have no factor n.l. All are 0 where the light is behind
    the vertex; cast shadows are not tested. Raises `ValueError` when shapes disagree.

    Parameters
    ----------
    vertices, normals, camera_positions, light_positions : array_like of float
        (V, 3) mm; (V, 3) unit; (J, 3) twice, of each picture, in mm.
    reference_distance_mm : float, optional
        Lights fall off with the square of their distance, to 1 at this one; without it they do not.

    Examples
    --------
    >>> ahead = [[0.0, 0.0, 600.0]]
    >>> point_light_lobes([[0.0, 0, 0]], [[0.0, 0, 1]], ahead, ahead).round(3)
    array([[[0.318, 0.119, 0.398, 2.626]]])
    """
    xyz = checked_array(vertices, ("V", 3), "vertices")
    cameras = checked_array(camera_positions, ("J", 3), "camera_positions")
    normal = checked_array(normals, xyz.shape, "normals")
    lights = checked_array(light_positions, cameras.shape, "light_positions")
    arrays = [np.ascontiguousarray(array) for array in (xyz, normal, cameras, lights)]
    lobes = np.empty((len(arrays[2]), len(arrays[0]), 4))
    reference = 0.0 if reference_distance_mm is None else float(reference_distance_mm)
    _fill_lobes(*arrays, reference, lobes)
    return lobes


def cosines_of_lobes(lobes: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return n.l and n.h (J, V) of lobes (J, V, 4) times any factor a picture; 0 where one is negative."""
    diffuse, broad, middle = np.moveaxis(np.asarray(lobes, np.float64)[..., :3], -1, 0)
    there = (broad > 0) & (middle > 0)
    lobe = np.where(there, broad, 1.0)
    n_h = np.where(there, (middle / lobe * PEAKS[0] / PEAKS[1]) ** (1 / 7), 0.0)
    return np.where(there, diffuse / lobe * n_h * PEAKS[0] * np.pi, 0.0), n_h


def lobe_slopes(
    vertices: ArrayLike, normals: ArrayLike, camera_positions: ArrayLike, light_positions: ArrayLike
) -> FloatArray:
    """Return (J, V, 4): e_1.l / n.l, e_2.l / n.l, e_1.h / n.h, e_2.h / n.h for tangents e of each normal.

    A normal tilted by t is (n + t_1 e_1 + t_2 e_2) / |.|, which multiplies n.l by
    (1 + t_1 e_1.l / n.l + t_2 e_2.l / n.l) / sqrt(1 + t.t), and n.h likewise. 0 where the light is behind.

    Parameters
    ----------
    vertices, normals, camera_positions, light_positions
        As in `point_light_lobes`.
    """
    given = vertices, normals, camera_positions, light_positions
    arrays = [np.ascontiguousarray(values, np.float64) for values in given]
    slopes = np.empty((len(arrays[2]), len(arrays[0]), 4))
    _fill_slopes(*arrays, *_tangents(arrays[1]), slopes)
    return slopes


def tilted_normals(normals: ArrayLike, tilt: ArrayLike) -> FloatArray:
    """Return unit normals (V, 3) tilted by `tilt` (V, 2) along the tangents of `lobe_slopes`; NaN is 0."""
    unit = np.asarray(normals, np.float64)
    angle = np.nan_to_num(np.asarray(tilt, np.float64))[..., None]
    first, second = _tangents(unit)
    return normalized(unit + (angle[:, 0] * first + angle[:, 1] * second) * unit.any(1, keepdims=True))


def _tangents(normals: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return two tangents (V, 3) of each normal, as Duff et al. (JCGT 6(1), 2017)."""
    x, y, z = normals.T
    sign = np.where(z >= 0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    first = np.stack([1 + sign * x * x * a, sign * x * y * a, -sign * x], 1)
    return first, np.stack([x * y * a, sign + y * y * a, -y], 1)


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_lobes(vertices, normals, cameras, lights, reference, lobes):  # type: ignore[no-untyped-def]
    """Fill lobes (J, V, 4); 8 twice is 64: constant whole exponents cost a tenth of other powers."""
    for j in range(len(cameras)):
        for i in range(len(vertices)):
            n_l = n_v = light_square = view_square = cross = 0.0
            for k in range(3):
                light, view = lights[j, k] - vertices[i, k], cameras[j, k] - vertices[i, k]
                n_l += normals[i, k] * light
                n_v += normals[i, k] * view
                light_square += light * light
                view_square += view * view
                cross += light * view
            lobes[j, i, :] = 0.0
            if n_l <= 0.0 or view_square == 0.0:
                continue
            light_length, view_length = np.sqrt(light_square), np.sqrt(view_square)
            n_l, n_v = n_l / light_length, n_v / view_length
            half = 2.0 + 2.0 * cross / (light_length * view_length)
            falloff = reference * reference / light_square if reference > 0.0 else 1.0
            lobes[j, i, 0] = falloff * n_l / np.pi
            n_h = min((n_l + n_v) / np.sqrt(half), 1.0) if half > 1e-12 else 0.0
            if n_h > 0.0:
                power8 = n_h**8
                lobes[j, i, 1] = falloff * 3.0 / (8.0 * np.pi) * n_h
                lobes[j, i, 2] = falloff * 10.0 / (8.0 * np.pi) * power8
                lobes[j, i, 3] = falloff * 66.0 / (8.0 * np.pi) * power8**8


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_slopes(vertices, normals, cameras, lights, first, second, slopes):  # type: ignore[no-untyped-def]
    """Fill slopes (J, V, 4): p_1, p_2, q_1, q_2."""
    for j in range(len(cameras)):
        for i in range(len(vertices)):
            slopes[j, i, :] = 0.0
            n_l = n_h = light_square = view_square = 0.0
            for k in range(3):
                light, view = lights[j, k] - vertices[i, k], cameras[j, k] - vertices[i, k]
                n_l += normals[i, k] * light
                light_square += light * light
                view_square += view * view
            if n_l <= 0.0:
                continue
            ratio = np.sqrt(light_square / max(view_square, 1e-300))
            p0 = p1 = q0 = q1 = 0.0
            for k in range(3):
                light = lights[j, k] - vertices[i, k]
                half = light + ratio * (cameras[j, k] - vertices[i, k])
                n_h += normals[i, k] * half
                p0 += first[i, k] * light
                p1 += second[i, k] * light
                q0 += first[i, k] * half
                q1 += second[i, k] * half
            slopes[j, i, 0], slopes[j, i, 1] = p0 / n_l, p1 / n_l
            if n_h > 0.0:
                slopes[j, i, 2], slopes[j, i, 3] = q0 / n_h, q1 / n_h


@njit(cache=True, nogil=True, error_model="numpy")
def turn_lobes(lobes, slopes, tilt, rows, turned):  # type: ignore[no-untyped-def]
    """Fill turned (J, V, 4), lobes of normals tilted by `tilt` (V, 2), of the vertices `rows` (N,)."""
    for j in range(lobes.shape[0]):
        for i in range(len(rows)):
            v = rows[i]
            t0, t1 = tilt[v, 0], tilt[v, 1]
            length = 1.0 / np.sqrt(1.0 + t0 * t0 + t1 * t1)
            near = max(1.0 + t0 * slopes[j, v, 0] + t1 * slopes[j, v, 1], 0.0) * length
            half = max(1.0 + t0 * slopes[j, v, 2] + t1 * slopes[j, v, 3], 0.0) * length
            power8 = half**8
            turned[j, v, 0] = lobes[j, v, 0] * near
            turned[j, v, 1] = lobes[j, v, 1] * half
            turned[j, v, 2] = lobes[j, v, 2] * power8
            turned[j, v, 3] = lobes[j, v, 3] * power8**8


def point_light_radiance(reflectance: VertexReflectance, lobes: ArrayLike) -> FloatArray:
    """Return (J, V, 3) linear radiance of vertices whose lobes (J, V, 4) are lit; NaN where not known.

    `reflectance` is that of V vertices; `lobes` are those of `point_light_lobes`. Raises `ValueError` when
    they have another shape.
    """
    terms = checked_array(lobes, ("J", len(reflectance.known), 4), "lobes")
    gloss = np.einsum("jvs,vs->jv", terms[..., 1:], reflectance.weights)
    return terms[..., :1] * reflectance.diffuse_linear + gloss[..., None]
