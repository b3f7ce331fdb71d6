"""Radiance of vertices under light from everywhere, and its derivatives by normals and directions of view."""

from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
from numpy.polynomial.legendre import Legendre, leggauss, legvander
from scipy.interpolate import CubicSpline

from scan2albedo.core.arrays import EPSILON, ArrayLike, FloatArray, all_finite, checked_array, dots, norms
from scan2albedo.errors import ReflectanceError
from scan2albedo.geometry.mesh import normalized
from scan2albedo.lighting.harmonics import harmonic_degrees, harmonics, harmonics_gradient
from scan2albedo.reflectance.vertex_reflectance import EXPONENTS, VertexReflectance, checked_coefficients

Lobe = Literal["tilted", "full"]
"""`tilted`: the true lobe of each view, averaged around its mean direction. `full`, as Han, Wang and Xu
have it: the lobe of v = n over the whole sphere, turned to the mirrored view."""

ORDER = 8
_DEGREES = harmonic_degrees(ORDER)
HARMONICS = len(_DEGREES)
"""Coefficients a channel."""


def lambert_coefficients(order: int = ORDER) -> FloatArray:
    """Return (order + 1,) A_l / pi = 2 int_0^1 t P_l(t) dt (Ramamoorthi and Hanrahan, JOSA A 2001)."""
    terms = (Legendre.basis(degree) * Legendre.basis(1) for degree in range(order + 1))
    return np.array([2 * term.integ(lbnd=0)(1.0) for term in terms])


def lobe_coefficients(exponent: float, order: int = ORDER) -> FloatArray:
    """Return (order + 1,) coefficients B_l of a Blinn-Phong lobe with the exponent s, seen along the normal.

    With v = n the half vector halves the angle, and over the full sphere with a = s / 2

        B_l = (s + 2) / 4 integral of ((1 + t) / 2)^a P_l(t) dt,
        B_0 = 1,   B_{l+1} = B_l (a - l) / (a + l + 2).

    Raises `ValueError` when s is not more than 0.
    """
    if not exponent > 0:
        raise ValueError(f"exponent must be more than 0, got {exponent}")
    half, degree = exponent / 2, np.arange(order)
    return np.concatenate([[1.0], np.cumprod((half - degree) / (half + degree + 2))])


def tilted_lobe(
    angle_rad: ArrayLike, exponent: float, *, derivative: int = 0
) -> tuple[FloatArray, FloatArray]:
    """Return coefficients (..., 9) of the true lobe, averaged around its mean direction, and that direction.

    Lobes lean from the mirrored view towards the normal, broad ones most. The second array is the tilt in rad
    from n to the mean direction, in the plane of n and v away from v; the mirrored view has the tilt
    `angle_rad`, between n and v. From pi / 2 on (a surface that is not seen) coefficients are 0. With
    `derivative` 1 both are differentiated by the angle. Raises `ValueError` when the exponent is not more
    than 0 or an angle not finite. `python tools/bench photographs/lobes` compares it with the full lobe.
    """
    if not exponent > 0:
        raise ValueError(f"exponent must be more than 0, got {exponent}")
    angle = np.asarray(angle_rad, float)
    if not all_finite(angle):
        raise ValueError("angle_rad holds NaN or infinite values")
    values = _spline(exponent)(np.clip(angle, 0.0, np.pi / 2), derivative)
    return np.where(angle[..., None] < np.pi / 2, values[..., :-1], 0.0), values[..., -1]


@cache
def _spline(exponent: float) -> CubicSpline:
    """Coefficients of the true lobe around its mean direction, and its tilt, by the angle between n and v."""
    angles = np.linspace(0, np.pi / 2, 33)
    heights = 96
    turns = 192  # of the views, and of the sums
    nodes, weights = leggauss(heights)
    t, across = (nodes + 1) / 2, np.sqrt(1 - ((nodes + 1) / 2) ** 2)
    # The lobe is even in the turn, so half a circle of midpoints covers all of it.
    forward = -across[:, None] * np.cos((np.arange(turns) + 0.5) * np.pi / turns)
    upward = np.broadcast_to(t[:, None], forward.shape)
    table = np.empty((len(angles), ORDER + 2))
    for row, angle in zip(table, angles, strict=True):
        light_view = np.cos(angle) * upward - np.sin(angle) * forward
        normal_half = (upward + np.cos(angle)) / np.sqrt(2 + 2 * light_view)
        kernel = (exponent + 2) / (8 * np.pi) * normal_half**exponent
        kernel *= (weights / 2)[:, None] * 2 * np.pi / turns
        tilt = np.arctan2(np.sum(kernel * forward), np.sum(kernel * upward))
        toward = np.clip(np.cos(tilt) * upward + np.sin(tilt) * forward, -1, 1)
        row[:-1], row[-1] = np.einsum("tp,tpl->l", kernel, legvander(toward, ORDER)), tilt
    table[0, -1] = 0.0
    return CubicSpline(angles, table)


@dataclass(frozen=True)
class EnvironmentShading:
    """Radiance towards the camera in its two parts; NaN where the reflectance is not known."""

    diffuse_linear: FloatArray
    """(V, 3)."""
    specular_linear: FloatArray
    """(V, 3), zero where the vertex faces away from the camera."""

    @property
    def radiance_linear(self) -> FloatArray:
        """The sum of the parts, (V, 3)."""
        return self.diffuse_linear + self.specular_linear


@dataclass(frozen=True)
class LightResponse:
    """Linear maps from light to the radiance of a unit of each reflectance toward the camera."""

    diffuse: FloatArray
    """(V, 81) A_l / pi Y_lm(n)."""
    specular: FloatArray
    """(V, 3, 81) B_l^s Y_lm(r), or at the lobe's mean direction, a row for each of `EXPONENTS`."""

    def shade(self, reflectance: VertexReflectance, light: FloatArray) -> EnvironmentShading:
        """Return the radiance under light (81, 3)."""
        diffuse = reflectance.diffuse_linear * (self.diffuse @ light)
        specular = np.einsum("vs,vsj->vj", reflectance.weights, self.specular @ light)
        return EnvironmentShading(diffuse, specular)


def light_response(normals: ArrayLike, toward_camera: ArrayLike, *, lobe: Lobe = "tilted") -> LightResponse:
    """Return how vertices respond to light, from their unit normals and directions to the camera (V, 3).

    Needs 2.6 kB a vertex. Raises `ReflectanceError` when a vector is not a unit vector, `ValueError` when
    shapes disagree or for an unknown `Lobe`.
    """
    n = unit_vectors(normals, "normals")
    v = unit_vectors(checked_array(toward_camera, n.shape, "toward_camera"), "toward_camera")
    if lobe not in ("tilted", "full"):
        raise ValueError(f"lobe must be 'tilted' or 'full', got {lobe!r}")
    cosine = dots(n, v)
    mirror = 2 * cosine[:, None] * n - v
    along = mirror - cosine[:, None] * n
    angle, outward = np.arctan2(norms(along), cosine), normalized(along)
    specular = np.empty((len(n), len(EXPONENTS), HARMONICS))
    for k, exponent in enumerate(EXPONENTS):
        around = mirror
        if lobe == "tilted":
            response, tilt = tilted_lobe(angle, exponent)
            around = np.cos(tilt)[:, None] * n + np.sin(tilt)[:, None] * outward
        else:
            response = np.where(cosine[:, None] > 0, lobe_coefficients(exponent), 0.0)
        specular[:, k] = response[:, _DEGREES] * harmonics(around, ORDER)
    return LightResponse(diffuse_response(n), specular)


def diffuse_response(normals: FloatArray) -> FloatArray:
    """Return (V, 81) A_l / pi Y_lm(n), the response of a white diffuse surface without shadows."""
    return harmonics(normals, ORDER) * lambert_coefficients()[_DEGREES]


def shade_environment(
    reflectance: VertexReflectance,
    normals: ArrayLike,
    toward_camera: ArrayLike,
    light: ArrayLike,
    *,
    lobe: Lobe = "tilted",
) -> EnvironmentShading:
    """Return the radiance of vertices under distant light, harmonics of order 8, without cast shadows.

        diffuse = c sum A_l / pi L_lm Y_lm(n),   specular = sum_s w_s sum B_l^s L_lm Y_lm(r),
        r = 2 (n.v) n - v.

    Raises `ReflectanceError` when a vector is not a unit vector or the light is not finite; `ValueError` when
    shapes disagree.

    Parameters
    ----------
    reflectance : VertexReflectance
    normals, toward_camera : (V, 3) array_like of float
        Unit vectors n and v.
    light : (81, 3) array_like of float
        Coefficients L_lm of the radiance, as from `project_environment`.
    lobe : {"tilted", "full"}
        `full` is the formula of Han, Wang and Xu, the one above; `tilted` replaces r by the lobe's mean
        direction, which is nearest to the truth at oblique views.
    """
    coefficients = checked_coefficients(light, (HARMONICS, 3), "light")
    response = light_response(normals, toward_camera, lobe=lobe)
    if len(reflectance.known) != len(response.diffuse):
        raise ValueError(f"{len(reflectance.known)} vertices reflect, {len(response.diffuse)} have normals")
    return response.shade(reflectance, coefficients)


def unit_vectors(vectors: ArrayLike, name: str) -> FloatArray:
    """Return vectors (V, 3), or raise `ValueError` for the shape, `ReflectanceError` for another length."""
    unit = checked_array(vectors, ("V", 3), name)
    length = norms(unit)
    wrong = ~(np.abs(length - 1) < 1e-4)
    if wrong.any():
        first = np.flatnonzero(wrong)[0]
        raise ReflectanceError(
            f"{name} of vertex {first} is {unit[first]} of length {length[first]:.6g}, no unit vector "
            f"({wrong.sum()} in all); normalise, and leave out vertices without a surface around them"
        )
    return unit


def shading_gradient(
    reflectance: VertexReflectance, normals: FloatArray, toward_camera: FloatArray, light: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives of `shade_environment`'s radiance under light (81, 3), lobes "tilted".

    By normals and by directions to the camera, both (V, 3, 3), rows by channel, columns by coordinate; right
    for changes along the sphere. The V vertices are known, their normals n and directions to the camera v
    unit vectors with c = n.v > 0. With e = (c n - v) / sin(angle) and f = (n - c v) / sin(angle), the angle
    between n and v has the derivatives e by n and -f by v, and each lobe stands around m = cos(tilt) n +
    sin(tilt) e.
    """
    n, v = normals, toward_camera
    attenuated = lambert_coefficients()[_DEGREES][:, None] * light
    diffuse = np.einsum("vhi,hj->vji", harmonics_gradient(n, ORDER), attenuated, optimize=True)
    by_normal = reflectance.diffuse_linear[:, :, None] * diffuse
    by_view = np.zeros_like(by_normal)
    cosine = dots(n, v)
    along = cosine[:, None] * n - v
    sine = norms(along)
    angle = np.arctan2(sine, cosine)
    # Straight ahead there is no plane of n and v, and none is needed: e = f = 0, and both sines vanish alike.
    ahead = sine < np.sqrt(EPSILON)
    e, f = (np.where(ahead[:, None], 0.0, normalized(u)) for u in (along, n - cosine[:, None] * v))
    for k, exponent in enumerate(EXPONENTS):
        response, tilt = tilted_lobe(angle, exponent)
        slope, tilt_slope = tilted_lobe(angle, exponent, derivative=1)
        cos_tilt, sin_tilt = np.cos(tilt)[:, None], np.sin(tilt)[:, None]
        m = cos_tilt * n + sin_tilt * e
        by_angle = np.einsum("vh,vh,hj->vj", slope[:, _DEGREES], harmonics(m, ORDER), light, optimize=True)
        by_m = np.einsum(
            "vh,vhi,hj->vji", response[:, _DEGREES], harmonics_gradient(m, ORDER), light, optimize=True
        )
        turn = tilt_slope[:, None] * (cos_tilt * e - sin_tilt * n)
        by_angle = by_angle + np.einsum("vji,vi->vj", by_m, turn)
        ratio = np.where(ahead, tilt_slope, sin_tilt[:, 0] / np.where(ahead, 1.0, sine))[:, None, None]
        across = ratio * (by_m - np.einsum("vji,vi,vk->vjk", by_m, e, e))
        across_n = np.einsum("vji,vi->vj", across, n)[:, :, None]
        by_lobe = cos_tilt[:, :, None] * by_m + cosine[:, None, None] * across + across_n * v[:, None, :]
        weight = reflectance.weights[:, k, None, None]
        by_normal += weight * (by_lobe + by_angle[:, :, None] * e[:, None, :])
        by_view += weight * (across_n * n[:, None, :] - across - by_angle[:, :, None] * f[:, None, :])
    return by_normal, by_view
