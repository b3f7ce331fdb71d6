"""Compiled shading of many surface points under a few lights; `brdf` is the readable reference."""

from __future__ import annotations

import numpy as np
from numba import njit

OREN_NAYAR, MINNAERT = 0, 1


@njit(cache=True, nogil=True)
def shade(  # type: ignore[no-untyped-def]
    position,
    normal,
    visible,
    lights,
    view,
    brdf,
    roughness,
    specular,
    exponent,
    scale,
    light_out,
    specular_out,
):
    """Fill `light_out` (I_a + I_d, with I_a = 1) and `specular_out` (I_s) of N points.

    Parameters
    ----------
    position, normal : (N, 3) float64
        Millimetres; unit.
    visible : (L, N) uint8
        Whether each light reaches each point.
    lights : (L, 5) float64
        Unit direction, 1/distance (0 for a distant light), intensity.
    view : (3,) float64
        Unit direction to the viewer.
    brdf : int
        `OREN_NAYAR` (Lambert is roughness 0) or `MINNAERT`.
    roughness : float
        Sigma in radians, or Minnaert's exponent.
    specular, exponent : float
        Strength of Phong's highlight for a light of intensity 1, and its exponent.
    scale : (N,) float64
        Multiplies the highlight.
    light_out, specular_out : (N,) float64
        Filled.
    """
    variance = roughness * roughness
    a = 1.0 - 0.5 * variance / (variance + 0.33)
    b = 0.45 * variance / (variance + 0.09)
    for i in range(position.shape[0]):
        n0, n1, n2 = normal[i, 0], normal[i, 1], normal[i, 2]
        n_v = n0 * view[0] + n1 * view[1] + n2 * view[2]
        cos_r = max(n_v, 0.0)
        light, gloss = 1.0, 0.0
        for k in range(lights.shape[0]):
            if visible[k, i] == 0:
                continue
            inverse = lights[k, 3]
            l0 = lights[k, 0] - inverse * position[i, 0]
            l1 = lights[k, 1] - inverse * position[i, 1]
            l2 = lights[k, 2] - inverse * position[i, 2]
            square = max(l0 * l0 + l1 * l1 + l2 * l2, 1e-12)
            length = np.sqrt(square)
            n_l = (n0 * l0 + n1 * l1 + n2 * l2) / length
            if n_l <= 0.0:
                continue
            l_v = (l0 * view[0] + l1 * view[1] + l2 * view[2]) / length
            energy = lights[k, 4] / square
            if brdf == MINNAERT:
                light += energy * n_l**roughness * max(n_v, 1e-4) ** (roughness - 1.0)
            else:
                s = max(l_v - n_l * cos_r, 0.0)
                light += energy * n_l * (a + b * s / max(max(n_l, cos_r), 1e-4))
            if specular > 0.0:
                r_v = min(2.0 * n_l * n_v - l_v, 1.0)
                if r_v > 0.0:
                    gloss += energy * r_v**exponent
        light_out[i] = light
        specular_out[i] = specular * scale[i] * gloss
