"""How the radiance of vertices in light from everywhere changes with normals and lines of sight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scan2albedo.geometry.mesh import normalized
from scan2albedo.lighting.harmonics import harmonic_degrees, harmonics, harmonics_gradient
from scan2albedo.reflectance.lobe_coefficients import (
    ORDER,
    lambert_coefficients,
    tilted_lobe,
    tilted_lobe_slopes,
)
from scan2albedo.reflectance.vertex_reflectance import EXPONENTS, VertexReflectance

FloatArray = NDArray[np.float64]

_DEGREES = harmonic_degrees(ORDER)
_AHEAD = 1e-7
"""Sine of the angle between n and v below which the mirrored direction has no plane."""


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
    """Return the derivatives of `shade_environment`'s radiance, lobes "tilted".

    Parameters
    ----------
    reflectance : VertexReflectance
        Of V known vertices.
    normals, toward_camera : (V, 3) float64
        Unit vectors, v on the side of n.
    light : (81, 3) float64
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
