"""Radiance of a vertex of unit albedo, and of unit weight of each lobe, under a point light."""

import numpy as np

from scan2albedo.core.arrays import ArrayLike, FloatArray, checked_array
from scan2albedo.core.compiled import compiled, triple
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.rigid import dot, minus
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
    views = vertices, normals, camera_positions, light_positions
    return lobes_and_slopes(*views, reference_distance_mm)[0]


def lobes_and_slopes(
    vertices: ArrayLike,
    normals: ArrayLike,
    camera_positions: ArrayLike,
    light_positions: ArrayLike,
    reference_distance_mm: float | None = None,
) -> FloatArray:
    """Return (2, J, V, 4) what `point_light_lobes` and `lobe_slopes` do."""
    xyz = checked_array(vertices, ("V", 3), "vertices")
    normal = checked_array(normals, xyz.shape, "normals")
    cameras = checked_array(camera_positions, ("J", 3), "camera_positions")
    lights = checked_array(light_positions, cameras.shape, "light_positions")
    found, frames = np.zeros((2, len(cameras), len(xyz), 4)), np.stack([normal, *_tangents(normal)], 1)
    _fill(*map(np.ascontiguousarray, (xyz, frames, cameras, lights)), reference_distance_mm or 0.0, *found)
    return found


def cosines_of_lobes(lobes: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return n.l and n.h (J, V) of lobes (J, V, 4) times any factor a picture; 0 where one is negative."""
    diffuse, broad, middle = np.moveaxis(np.asarray(lobes, float)[..., :3], -1, 0)
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
    return lobes_and_slopes(vertices, normals, camera_positions, light_positions)[1]


def tilted_normals(normals: ArrayLike, tilt: ArrayLike) -> FloatArray:
    """Return unit normals (V, 3) tilted by `tilt` (V, 2) along the tangents of `lobe_slopes`; NaN is 0."""
    unit = np.asarray(normals, float)
    angle = np.nan_to_num(np.asarray(tilt, float))[..., None]
    first, second = _tangents(unit)
    return normalized(unit + (angle[:, 0] * first + angle[:, 1] * second) * unit.any(1, keepdims=True))


def _tangents(normals: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return two tangents (V, 3) of each normal, as Duff et al. (JCGT 6(1), 2017)."""
    x, y, z = normals.T
    sign = np.where(z >= 0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    first = np.stack([1 + sign * x * x * a, sign * x * y * a, -sign * x], 1)
    return first, np.stack([x * y * a, sign + y * y * a, -y], 1)


@compiled(error_model="numpy")
def _fill(vertices, frames, cameras, lights, reference, lobes, slopes):  # type: ignore[no-untyped-def]
    """Fill lobes and slopes (J, V, 4), 0 so far; frames (V, 3, 3) are normals and tangents.

    8 twice is 64: constant whole exponents cost a tenth of other powers.
    """
    for j in range(len(cameras)):
        for i in range(len(vertices)):
            point, normal = triple(vertices, i), triple(frames[i], 0)
            light, view = minus(triple(lights, j), point), minus(triple(cameras, j), point)
            along, light_square, view_square = dot(normal, light), dot(light, light), dot(view, view)
            if along <= 0.0 or view_square == 0.0:
                continue
            light_length, view_length = np.sqrt(light_square), np.sqrt(view_square)
            n_l, n_v = along / light_length, dot(normal, view) / view_length
            half = 2.0 + 2.0 * dot(light, view) / (light_length * view_length)
            falloff = reference * reference / light_square if reference > 0.0 else 1.0
            lobes[j, i, 0] = falloff * n_l / np.pi
            n_h = min((n_l + n_v) / np.sqrt(half), 1.0) if half > 1e-12 else 0.0
            if n_h > 0.0:
                power8 = n_h**8
                lobes[j, i, 1] = falloff * 3.0 / (8.0 * np.pi) * n_h
                lobes[j, i, 2] = falloff * 10.0 / (8.0 * np.pi) * power8
                lobes[j, i, 3] = falloff * 66.0 / (8.0 * np.pi) * power8**8
            ratio = np.sqrt(light_square / view_square)
            both = light[0] + ratio * view[0], light[1] + ratio * view[1], light[2] + ratio * view[2]
            for t in range(2):
                tangent = triple(frames[i], 1 + t)
                slopes[j, i, t] = dot(tangent, light) / along
                if dot(normal, both) > 0.0:
                    slopes[j, i, 2 + t] = dot(tangent, both) / dot(normal, both)


@compiled(error_model="numpy")
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
    return radiance_of(terms, reflectance.diffuse_linear, reflectance.weights)


def radiance_of(lobes: FloatArray, albedo: FloatArray, weights: FloatArray) -> FloatArray:
    """Return (J, V, 3) as `point_light_radiance`, of albedos and weights (V, 3)."""
    gloss = np.einsum("jvs,vs->jv", lobes[..., 1:], weights)
    return lobes[..., :1] * albedo + gloss[..., None]
