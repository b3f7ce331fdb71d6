"""Compiled shading of many surface points under a few lights, with and without derivatives."""

import numpy as np
from numba import njit

COSINE_FLOOR = 1e-4
"""Cosines below this count as this where a model divides by them."""


@njit(cache=True, nogil=True)
def oren_nayar_coefficients(sigma):  # type: ignore[no-untyped-def]
    """Return A and B of Oren and Nayar, "Generalization of Lambert's reflectance model", 1994, eq. 30."""
    variance = sigma * sigma
    return 1.0 - 0.5 * variance / (variance + 0.33), 0.45 * variance / (variance + 0.09)


@njit(cache=True, nogil=True)
def lamp_factors(  # type: ignore[no-untyped-def]
    position, normal, visible, direction, nearness, view, minnaert, roughness, exponent, diffuse, lobe
):
    """Fill f / r^2 and (r.v)^m / r^2 of N points under one lamp of intensity 1, r in its own distances.

    f is Oren-Nayar's cos_i (A + B s / max(cos_i, cos_r)), s = max(0, l.v - cos_i cos_r), which has neither an
    azimuth nor a tangent; or Minnaert's cos_i^k cos_r^(k - 1). The highlight is Phong's, 0 where the mirrored
    light points away from the viewer, whatever the exponent.

    `position`, `normal` (N, 3) are in mm and unit; `visible` (N,) is the part of the lamp that reaches each
    point; `direction` (3,) and `view`, (N, 3) or (1, 3), are unit; `nearness` is 1/distance, 0 for a distant
    lamp. `roughness` is Oren-Nayar's sigma in radians (0 is Lambert), or Minnaert's exponent; an `exponent`
    below 0 leaves the highlight out. `diffuse`, `lobe` (N,) are filled.
    """
    a, b = oren_nayar_coefficients(roughness)
    for i in range(position.shape[0]):
        diffuse[i] = 0.0
        lobe[i] = 0.0
        if visible[i] == 0:
            continue
        v = i if view.shape[0] > 1 else 0
        n_l, n_v, l_v, square = 0.0, 0.0, 0.0, 0.0
        for c in range(3):
            toward = direction[c] - nearness * position[i, c]
            n_l += normal[i, c] * toward
            n_v += normal[i, c] * view[v, c]
            l_v += toward * view[v, c]
            square += toward * toward
        if n_l <= 0.0:
            continue
        square = max(square, 1e-12)
        length = np.sqrt(square)
        n_l /= length
        l_v /= length
        energy = visible[i] / square
        if minnaert:
            diffuse[i] = energy * n_l**roughness * max(n_v, COSINE_FLOOR) ** (roughness - 1.0)
        else:
            cos_r = max(n_v, 0.0)
            s = max(l_v - n_l * cos_r, 0.0)
            diffuse[i] = energy * n_l * (a + b * s / max(max(n_l, cos_r), COSINE_FLOOR))
        r_v = min(2.0 * n_l * n_v - l_v, 1.0)
        if exponent >= 0.0 and r_v > 0.0:
            lobe[i] = energy * r_v**exponent


@njit(cache=True, nogil=True, error_model="numpy")
def shade_with_derivatives(  # type: ignore[no-untyped-def]
    position,
    normal,
    visible,
    visible_slope,
    lights,
    tangents,
    radius,
    view,
    minnaert,
    roughness,
    specular,
    exponent,
    scale,
    near,
    rough,
    glossy,
    light_out,
    specular_out,
    light_slope,
    specular_slope,
):
    """Fill I = I_a + I_d (I_a = 1), I_s, and their derivatives by the parameters of the light.

    The P parameters are, for each light, two coordinates of its direction and the logarithm of its intensity;
    then, where free (`near`, `rough`, `glossy`), `radius` / distance with `radius` in mm, sigma^2 (or
    Minnaert's exponent), strength of the highlight and the logarithm of its exponent.

    `position`, `normal`, `minnaert`, `roughness`, `exponent` are as in `lamp_factors`. `lights` (L, 5) hold
    unit direction, 1/distance (0 for a distant light) and intensity, `tangents` (L, 2, 3) the derivatives of
    each direction by its coordinates. `visible` (L, N) float32 is in [0, 1], and `visible_slope` (L, 2, N)
    float32 its derivatives by the direction's coordinates: an outline moves with the light. `view` (N, 3) is
    unit, `specular` the strength of the highlight for a light of intensity 1, `scale` (N,) multiplies it.
    `light_out`, `specular_out` (N,), `light_slope`, `specular_slope` (N, >= P), all float64, are filled.
    """
    a, b = oren_nayar_coefficients(roughness)
    variance = roughness * roughness
    a_slope = -0.5 * 0.33 / (variance + 0.33) ** 2
    b_slope = 0.45 * 0.09 / (variance + 0.09) ** 2
    count = 3 * lights.shape[0]
    at_near, at_rough, at_gloss = count, count + int(near), count + int(near) + int(rough)
    size = at_gloss + 2 * int(glossy)
    for i in range(position.shape[0]):
        for j in range(size):
            light_slope[i, j] = 0.0
            specular_slope[i, j] = 0.0
        n0, n1, n2 = normal[i, 0], normal[i, 1], normal[i, 2]
        v0, v1, v2 = view[i, 0], view[i, 1], view[i, 2]
        n_v = n0 * v0 + n1 * v1 + n2 * v2
        cos_r = max(n_v, 0.0)
        floored = max(n_v, COSINE_FLOOR)
        strength = specular * scale[i]
        light, gloss = 1.0, 0.0
        for k in range(lights.shape[0]):
            seen = visible[k, i]
            if seen == 0.0 and visible_slope[k, 0, i] == 0.0 and visible_slope[k, 1, i] == 0.0:
                continue
            inverse = lights[k, 3]
            l0 = lights[k, 0] - inverse * position[i, 0]
            l1 = lights[k, 1] - inverse * position[i, 1]
            l2 = lights[k, 2] - inverse * position[i, 2]
            length = np.sqrt(max(l0 * l0 + l1 * l1 + l2 * l2, 1e-12))
            n_l = (n0 * l0 + n1 * l1 + n2 * l2) / length
            if n_l <= 0.0:
                continue
            l_v = (l0 * v0 + l1 * v1 + l2 * v2) / length
            energy = lights[k, 4] / (length * length)
            s = max(l_v - n_l * cos_r, 0.0)
            larger = max(max(n_l, cos_r), COSINE_FLOOR)
            if minnaert:
                diffuse = n_l**roughness * floored ** (roughness - 1.0)
            else:
                diffuse = n_l * (a + b * s / larger)
            r_v, lobe = 0.0, 0.0
            if glossy or specular > 0.0:
                r_v = min(2.0 * n_l * n_v - l_v, 1.0)
                if r_v > 0.0:
                    lobe = r_v**exponent
            light += seen * energy * diffuse
            gloss += seen * energy * lobe
            for q in range(3 if near else 2):
                if q == 2:
                    j = at_near
                    t0, t1, t2 = -position[i, 0] / radius, -position[i, 1] / radius, -position[i, 2] / radius
                else:
                    j = 3 * k + q
                    t0, t1, t2 = tangents[k, q, 0], tangents[k, q, 1], tangents[k, q, 2]
                stretch = (l0 * t0 + l1 * t1 + l2 * t2) / (length * length)
                n_l_slope = (n0 * t0 + n1 * t1 + n2 * t2) / length - n_l * stretch
                l_v_slope = (v0 * t0 + v1 * t1 + v2 * t2) / length - l_v * stretch
                if minnaert:
                    turned = roughness * diffuse / n_l * n_l_slope
                else:
                    s_slope = l_v_slope - cos_r * n_l_slope if s > 0.0 else 0.0
                    if n_l >= cos_r and n_l > COSINE_FLOOR:
                        turned = a * n_l_slope + b * s_slope
                    else:
                        turned = n_l_slope * (a + b * s / larger) + n_l * b * s_slope / larger
                light_slope[i, j] += seen * energy * (turned - 2.0 * diffuse * stretch)
                if q < 2:
                    light_slope[i, j] += visible_slope[k, q, i] * energy * diffuse
                if r_v > 0.0:
                    lobe_slope = exponent * lobe / max(r_v, 1e-9) * (2.0 * n_v * n_l_slope - l_v_slope)
                    specular_slope[i, j] += strength * seen * energy * (lobe_slope - 2.0 * lobe * stretch)
                    if q < 2:
                        specular_slope[i, j] += strength * visible_slope[k, q, i] * energy * lobe
            light_slope[i, 3 * k + 2] += seen * energy * diffuse
            shine = strength * seen * energy * lobe
            specular_slope[i, 3 * k + 2] += shine
            if rough:
                if minnaert:
                    light_slope[i, at_rough] += seen * energy * diffuse * np.log(n_l * floored)
                else:
                    light_slope[i, at_rough] += seen * energy * n_l * (a_slope + b_slope * s / larger)
            if glossy and r_v > 0.0:
                specular_slope[i, at_gloss] += scale[i] * seen * energy * lobe
                specular_slope[i, at_gloss + 1] += shine * exponent * np.log(max(r_v, 1e-12))
        light_out[i] = light
        specular_out[i] = strength * gloss


@njit(cache=True, nogil=True, error_model="numpy")
def log_rows(  # type: ignore[no-untyped-def]
    value, mean, light, specular, light_slope, specular_slope, scale, likeness, rows
):
    """Fill `rows` (N, P + 3): derivatives of L = log(A I + I_s), A = exp(scale + likeness mean); log V - L.

    They are by the P parameters of the light, of which `light_slope` and `specular_slope` (N, P) are the
    derivatives, scale and likeness. `value` (N,) is log V.
    """
    size = light_slope.shape[1]
    for i in range(len(value)):
        albedo = np.exp(scale + likeness * mean[i])
        seen = albedo * light[i] + specular[i]
        for j in range(size):
            rows[i, j] = (albedo * light_slope[i, j] + specular_slope[i, j]) / seen
        rows[i, size] = albedo * light[i] / seen
        rows[i, size + 1] = rows[i, size] * mean[i]
        rows[i, size + 2] = value[i] - np.log(seen)
