"""Radiance of vertices under light from everywhere, and its derivatives by normals and directions of view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core.arrays import FloatArray
from scan2albedo.errors import ReflectanceError
from scan2albedo.geometry.mesh import normalized
from scan2albedo.lighting.harmonics import harmonic_degrees, harmonics, harmonics_gradient
from scan2albedo.reflectance.lobe_coefficients import (
    ORDER,
    Lobe,
    lambert_coefficients,
    lobe_coefficients,
    tilted_lobe,
    tilted_lobe_slopes,
)
from scan2albedo.reflectance.vertex_reflectance import EXPONENTS, VertexReflectance

_DEGREES = harmonic_degrees(ORDER)
HARMONICS = len(_DEGREES)
"""Coefficients a channel."""
_AHEAD = 1e-7
"""Sine of the angle between n and v below which the mirrored direction has no plane."""


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
    n, v = unit_vectors(normals, "normals"), unit_vectors(toward_camera, "toward_camera")
    if n.shape != v.shape:
        raise ValueError(f"normals are {n.shape} and toward_camera {v.shape}, expected (V, 3) both")
    specular = np.stack([_specular(lobe, s, n, v) for s in EXPONENTS], axis=1)
    return LightResponse(diffuse_response(n), specular)


def diffuse_response(normals: FloatArray) -> FloatArray:
    """Return (V, 81) A_l / pi Y_lm(n), the response of a white diffuse surface without shadows."""
    return harmonics(normals, ORDER) * lambert_coefficients(ORDER)[_DEGREES]


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

    Parameters
    ----------
    reflectance : VertexReflectance
        Of V vertices.
    normals, toward_camera : (V, 3) array_like of float
        Unit vectors n and v.
    light : (81, 3) array_like of float
        Coefficients L_lm of the radiance, as from `project_environment`.
    lobe : {"tilted", "full"}
        `full` is the formula of Han, Wang and Xu, the one above; `tilted` replaces r by the lobe's mean
        direction, which is nearest to the truth at oblique views.

    Raises
    ------
    ReflectanceError
        When a vector is not a unit vector or the light is not finite.
    ValueError
        When shapes disagree.

    Examples
    --------
    >>> white = VertexReflectance(np.full((1, 3), 0.5), np.zeros((1, 3)), np.array([True]))
    >>> light = np.zeros((81, 3))
    >>> light[0] = np.sqrt(4 * np.pi)  # radiance 1 from everywhere
    >>> shade_environment(white, [[0, 0, 1]], [[0, 0, 1]], light).radiance_linear.round(6).tolist()
    [[0.5, 0.5, 0.5]]
    """
    coefficients = checked_light(light)
    response = light_response(normals, toward_camera, lobe=lobe)
    if len(reflectance.known) != len(response.diffuse):
        raise ValueError(
            f"{len(reflectance.known)} vertices reflect, but there are {len(response.diffuse)} normals"
        )
    return response.shade(reflectance, coefficients)


def checked_light(light: ArrayLike) -> FloatArray:
    """Return (81, 3) coefficients, or raise `ValueError` for the shape, `ReflectanceError` for NaN."""
    coefficients = np.asarray(light, np.float64)
    if coefficients.shape != (HARMONICS, 3):
        raise ValueError(f"light must have shape ({HARMONICS}, 3), got {coefficients.shape}")
    if not np.isfinite(coefficients).all():
        raise ReflectanceError("the light's coefficients hold NaN or infinite values; project the map again")
    return coefficients


def _specular(lobe: Lobe, exponent: float, n: FloatArray, v: FloatArray) -> FloatArray:
    """Return (V, 81) B_l Y_lm at the directions that the lobe stands around."""
    cosine = np.einsum("vi,vi->v", n, v)
    mirror = 2 * cosine[:, None] * n - v
    if lobe == "tilted":
        along = mirror - cosine[:, None] * n
        sine = np.linalg.norm(along, axis=1)
        response, tilt = tilted_lobe(np.arctan2(sine, cosine), exponent)
        mirror = np.cos(tilt)[:, None] * n + np.sin(tilt)[:, None] * normalized(along)
    elif lobe == "full":
        response = np.where(cosine[:, None] > 0, lobe_coefficients(exponent, ORDER), 0.0)
    else:
        raise ValueError(f"lobe must be 'tilted' or 'full', got {lobe!r}")
    return response[:, _DEGREES] * harmonics(mirror, ORDER)


def unit_vectors(vectors: ArrayLike, name: str) -> FloatArray:
    """Return vectors (V, 3), or raise `ValueError` for the shape, `ReflectanceError` for another length."""
    unit = np.asarray(vectors, np.float64)
    if unit.ndim != 2 or unit.shape[1] != 3:
        raise ValueError(f"{name} must have shape (V, 3), got {unit.shape}")
    length = np.linalg.norm(unit, axis=1)
    wrong = ~(np.abs(length - 1) < 1e-4)
    if wrong.any():
        first = int(np.flatnonzero(wrong)[0])
        raise ReflectanceError(
            f"{name} of vertex {first} is {unit[first]} of length {length[first]:.6g}, no unit vector "
            f"({wrong.sum()} in all); normalise, and leave out vertices without a surface around them"
        )
    return unit


@dataclass(frozen=True)
class ShadingGradient:
    """Derivatives of the radiance (V, 3); rows by channel, columns by coordinate."""

    by_normal: FloatArray
    """(V, 3, 3), right for changes along the sphere."""
    by_view: FloatArray
    """(V, 3, 3), right for changes along the sphere."""


def shading_gradient(
    reflectance: VertexReflectance, normals: FloatArray, toward_camera: FloatArray, light: FloatArray
) -> ShadingGradient:
    """Return the derivatives of `shade_environment`'s radiance under light (81, 3), lobes "tilted".

    The V vertices are known, their normals and directions to the camera unit vectors with n.v > 0.
    """
    attenuated = lambert_coefficients(ORDER)[_DEGREES][:, None] * light
    diffuse = np.einsum("vhi,hj->vji", harmonics_gradient(normals, ORDER), attenuated, optimize=True)
    by_normal = reflectance.diffuse_linear[:, :, None] * diffuse
    by_view = np.zeros_like(by_normal)
    for k, exponent in enumerate(EXPONENTS):
        weight = reflectance.weights[:, k, None, None]
        lobe = _lobe_gradient(exponent, normals, toward_camera, light)
        by_normal += weight * lobe.by_normal
        by_view += weight * lobe.by_view
    return ShadingGradient(by_normal, by_view)


def _lobe_gradient(exponent: float, n: FloatArray, v: FloatArray, light: FloatArray) -> ShadingGradient:
    """Return the derivatives of a lobe of weight 1.

    With c = n.v, e = (c n - v) / sin(angle) and f = (n - c v) / sin(angle), the angle between n and v has the
    derivatives e by n and -f by v, and the lobe stands around m = cos(tilt) n + sin(tilt) e.
    """
    cosine = np.einsum("vi,vi->v", n, v)
    along = cosine[:, None] * n - v
    sine = np.linalg.norm(along, axis=1)
    angle = np.arctan2(sine, cosine)
    # Straight ahead there is no plane of n and v, and none is needed: e = f = 0, and both sines vanish alike.
    ahead = sine < _AHEAD
    e, f = (np.where(ahead[:, None], 0.0, normalized(u)) for u in (along, n - cosine[:, None] * v))
    response, tilt = tilted_lobe(angle, exponent)
    response_slope, tilt_slope = tilted_lobe_slopes(angle, exponent)
    cos_tilt, sin_tilt = np.cos(tilt)[:, None], np.sin(tilt)[:, None]
    m = cos_tilt * n + sin_tilt * e
    by_angle = np.einsum(
        "vh,vh,hj->vj", response_slope[:, _DEGREES], harmonics(m, ORDER), light, optimize=True
    )
    by_m = np.einsum(
        "vh,vhi,hj->vji", response[:, _DEGREES], harmonics_gradient(m, ORDER), light, optimize=True
    )
    turn = tilt_slope[:, None] * (cos_tilt * e - sin_tilt * n)
    by_angle = by_angle + np.einsum("vji,vi->vj", by_m, turn)
    ratio = np.where(ahead, tilt_slope, sin_tilt[:, 0] / np.where(ahead, 1.0, sine))[:, None, None]
    across = ratio * (by_m - np.einsum("vji,vi,vk->vjk", by_m, e, e))
    across_n = np.einsum("vji,vi->vj", across, n)[:, :, None]
    by_normal = cos_tilt[:, :, None] * by_m + cosine[:, None, None] * across + across_n * v[:, None, :]
    by_view = across_n * n[:, None, :] - across
    return ShadingGradient(
        by_normal + by_angle[:, :, None] * e[:, None, :], by_view - by_angle[:, :, None] * f[:, None, :]
    )
