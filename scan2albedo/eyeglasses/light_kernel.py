"""Compiled shading of points under one distant light; `lighting.brdf` is the readable reference."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def add_light(  # type: ignore[no-untyped-def]
    normal,
    viewer,
    albedo,
    visible,
    toward,
    irradiance,
    roughness,
    specular,
    exponent,
    diffuse,
    highlight,
    radiance,
):
    """Add E (albedo f_d / pi + specular f_s) to `radiance` (N, 3); leave f_d, f_s in the two before it.

    Parameters
    ----------
    normal, viewer, albedo : (N, 3) float64
        Unit normal, unit direction to the viewer, linear albedo.
    visible : (N,) uint8
        Whether the light reaches each point; only where n.l > 0.
    toward, irradiance : (3,) float64
        Unit direction of the light and E.
    roughness : float
        Sigma of Oren and Nayar in radians; 0 is Lambert.
    specular, exponent : float
        Of Phong's highlight.
    diffuse, highlight : (N,) float64
        Overwritten.
    radiance : (N, 3) float64
    """
    variance = roughness * roughness
    a = 1.0 - 0.5 * variance / (variance + 0.33)
    b = 0.45 * variance / (variance + 0.09)
    for i in range(normal.shape[0]):
        diffuse[i] = highlight[i] = 0.0
        if visible[i] == 0:
            continue
        n_l = n_v = l_v = 0.0
        for c in range(3):
            n_l += normal[i, c] * toward[c]
            n_v += normal[i, c] * viewer[i, c]
            l_v += viewer[i, c] * toward[c]
        if n_l <= 0.0:
            continue
        cos_r = max(n_v, 0.0)
        diffuse[i] = n_l * (a + b * max(l_v - n_l * cos_r, 0.0) / max(max(n_l, cos_r), 1e-4))
        r_v = 2.0 * n_l * n_v - l_v
        if specular > 0.0 and r_v > 0.0:
            highlight[i] = min(r_v, 1.0) ** exponent
        for c in range(3):
            matte = albedo[i, c] / np.pi * diffuse[i]
            radiance[i, c] += irradiance[c] * (matte + specular * highlight[i])
