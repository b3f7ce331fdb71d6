"""The analytical skin reflectance model: ambient, diffuse and specular light of several point lights."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from scan2albedo.core.arrays import FloatArray, checked_array
from scan2albedo.core.lights import PointLight

_BRDFS = "lambert", "minnaert", "oren-nayar"


@dataclass(frozen=True)
class Reflectance:
    """How the surface reflects; the albedo is not part of it.

    `brdf` is "oren-nayar", "lambert" or "minnaert"; `roughness` is Oren-Nayar's sigma in radians (0 is
    Lambert) or Minnaert's exponent (1 is Lambert). `specular_strength` is Phong's k_s for a light of
    intensity 1, in the unit of the texture; `exponent` is Phong's m. ValueError for an unknown `brdf`, rough
    Lambert, or a number that is negative or not finite.
    """

    brdf: str = "oren-nayar"
    roughness: float = 0.0
    specular_strength: float = 0.0
    exponent: float = 16.0

    def __post_init__(self) -> None:
        if self.brdf not in _BRDFS:
            raise ValueError(f"brdf is {self.brdf!r}, expected one of {_BRDFS}")
        if self.brdf == "lambert" and self.roughness != 0:
            raise ValueError(f"a Lambertian surface has roughness 0, got {self.roughness}")
        for name in ("roughness", "specular_strength", "exponent"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} is {getattr(self, name)}, expected a finite number, 0 or more")

    def parameters(self) -> dict[str, object]:
        """Return the numbers by their names in files of results."""
        return {
            "brdf": self.brdf,
            "minnaert_exponent" if self.brdf == "minnaert" else "sigma_rad": self.roughness,
            "specular_strength": self.specular_strength,
            "specular_exponent": self.exponent,
        }


@dataclass(frozen=True)
class Shading:
    """`light` (N,) = I_a + I_d with I_a = 1, and `specular` (N,) = I_s in the unit of the texture.

    `light_linear` and `specular_linear` (N, 3) are in the lamps' colours; `lamps` (L, N) each lamp's part.
    """

    light: FloatArray
    specular: FloatArray
    light_linear: FloatArray
    specular_linear: FloatArray
    lamps: FloatArray


def light_from_direction(direction: ArrayLike, distance_mm: float, intensity: float) -> PointLight:
    """Return the `PointLight` in `direction` (3,), of any length.

    >>> round(math.degrees(light_from_direction((1, 0, 1), math.inf, 1.0).azimuth_rad))
    45
    """
    x, y, z = np.asarray(direction, np.float64) / np.linalg.norm(direction)
    return PointLight(math.atan2(x, z), math.asin(max(-1.0, min(1.0, y))), distance_mm, float(intensity))


def shade_points(
    position: ArrayLike,
    normal: ArrayLike,
    lights: Sequence[PointLight],
    reflectance: Reflectance,
    *,
    visible: ArrayLike | None = None,
    view_direction: ArrayLike = (0.0, 0.0, 1.0),
    specular_scale: ArrayLike | None = None,
) -> Shading:
    """Evaluate the ASRM: T = A (I_a + I_d) + I_s.

    I_d = sum_k V_k E_k f(n, l_k, v), I_s = k_s sum_k V_k E_k phong(n, l_k, v), I_a = 1, with V the visibility
    and E = intensity (distance/r)^2 (no falloff for a distant light), times the lamp's colour.

    `position` (N, 3) is in mm, `normal` (N, 3) unit. `visible` (L, N) is 0 where a light is hidden; all is
    visible when None. `view_direction` (3,) or (N, 3), of any length, points toward the viewer;
    `specular_scale` (N,) multiplies I_s. ValueError for shapes that do not fit, or what is not finite.

    .. [1] G. Toderici, G. Passalis, T. Theoharis, I. Kakadiaris, "An automated method for human face
       modeling and relighting with application to face recognition", section 3.2.1.
    """
    # Compiled loops would read past the end of other arrays, or turn them to NaN.
    xyz = np.ascontiguousarray(checked_array(position, ("N", 3), "position", finite=ValueError))
    unit = np.ascontiguousarray(checked_array(normal, xyz.shape, "normal", finite=ValueError))
    count = len(xyz)
    seen = np.ones((len(lights), count), np.uint8) if visible is None else np.asarray(visible)
    checked_array(seen, (len(lights), count), "visible")
    scale = np.ones(count) if specular_scale is None else specular_scale
    scale = checked_array(scale, (count,), "specular_scale", finite=ValueError)
    view = np.asarray(view_direction, np.float64)
    if view.shape not in ((3,), (count, 3)) or not np.isfinite(view).all() or not view.any(-1).all():
        raise ValueError(f"view_direction is {view.tolist()}, expected three finite numbers, not all zero")
    colors = None if all(lamp.white for lamp in lights) else np.array([lamp.color_linear for lamp in lights])
    toward = view / np.linalg.norm(view, axis=-1, keepdims=True)
    rows = [(*lamp.direction, 1 / lamp.distance_mm, lamp.intensity) for lamp in lights]
    return shade_rows(xyz, unit, seen, np.reshape(rows, (-1, 5)), toward, reflectance, scale, colors)


def shade_rows(
    position: FloatArray,
    normal: FloatArray,
    visible: NDArray,
    rows: FloatArray,
    view: FloatArray,
    reflectance: Reflectance,
    scale: FloatArray,
    colors: FloatArray | None = None,
) -> Shading:
    """Do as `shade_points` for `rows` (L, 5) of lamps: direction, 1/distance, intensity; nothing is checked.

    `view`, (3,) or (N, 3), is unit; `colors` (L, 3) are the lamps', all white when None.
    """
    count = len(position)
    light, gloss, lamps = np.ones(count), np.zeros(count), np.empty((len(rows), count))
    tint, sheen = np.zeros((2, count, 3))
    for k, (row, seen) in enumerate(zip(rows, visible, strict=True)):
        at = row[:3], row[3], np.atleast_2d(view), reflectance
        lamps[k], highlight = row[4] * lamp_factors(position, normal, seen, *at)
        light += lamps[k]
        gloss += highlight
        if colors is not None:
            tint += lamps[k][:, None] * (colors[k] - 1)
            sheen += highlight[:, None] * (colors[k] - 1)
    strength = reflectance.specular_strength * scale
    whole = strength[:, None] * (gloss[:, None] + sheen)
    return Shading(light, strength * gloss, light[:, None] + tint, whole, lamps)


def lamp_factors(
    position: FloatArray,
    normal: FloatArray,
    visible: NDArray,
    direction: FloatArray,
    nearness: float,
    view: FloatArray,
    reflectance: Reflectance,
) -> FloatArray:
    """Return (2, N) what multiplies a lamp's intensity in light on the albedo, in highlights of k_s = 1."""
    lamp = np.ascontiguousarray(visible), np.ascontiguousarray(direction), float(nearness)
    exponent = float(reflectance.exponent) if reflectance.specular_strength > 0 else -1.0
    model = reflectance.brdf == "minnaert", float(reflectance.roughness), exponent
    factors: FloatArray = factors_of_lamp(position, normal, *lamp, view, *model)
    return factors


COSINE_FLOOR = 1e-4
"""Cosines below this count as this where a model divides by them."""


@njit(cache=True, nogil=True)
def oren_nayar_coefficients(sigma):  # type: ignore[no-untyped-def]
    """Return A and B of Oren and Nayar, "Generalization of Lambert's reflectance model", 1994, eq. 30."""
    variance = sigma * sigma
    return 1.0 - 0.5 * variance / (variance + 0.33), 0.45 * variance / (variance + 0.09)


@njit(cache=True, nogil=True)
def factors_of_lamp(  # type: ignore[no-untyped-def]
    position, normal, visible, direction, nearness, view, minnaert, roughness, exponent
):
    """Return (2, N) f / r^2 and (r.v)^m / r^2 of N points under a lamp of intensity 1, r in its distances.

    f is Oren-Nayar's cos_i (A + B s / max(cos_i, cos_r)), s = max(0, l.v - cos_i cos_r), which has neither an
    azimuth nor a tangent; or Minnaert's cos_i^k cos_r^(k - 1). The highlight is Phong's, 0 where the mirrored
    light points away from the viewer, whatever the exponent.

    `position`, `normal` (N, 3) are in mm and unit; `visible` (N,) is the part of the lamp that reaches each
    point; `direction` (3,) and `view`, (N, 3) or (1, 3), are unit; `nearness` is 1/distance, 0 for a distant
    lamp. `roughness` is Oren-Nayar's sigma in radians (0 is Lambert), or Minnaert's exponent; an `exponent`
    below 0 leaves the highlight out.
    """
    a, b = oren_nayar_coefficients(roughness)
    factors = np.zeros((2, len(position)))
    diffuse, lobe = factors
    for i in range(position.shape[0]):
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
    return factors


@njit(cache=True, nogil=True, error_model="numpy")
def shade_with_derivatives(  # type: ignore[no-untyped-def]
    position, normal, visible, visible_slope, lights, tangents, radius, view, minnaert, roughness, specular,
    exponent, scale, near, rough, glossy, light_out, specular_out, light_slope, specular_slope
):  # fmt: skip
    """Fill I = I_a + I_d (I_a = 1), I_s, and their derivatives by the parameters of the light.

    The P parameters are, for each light, two coordinates of its direction and the logarithm of its intensity;
    then, where free (`near`, `rough`, `glossy`), `radius` / distance with `radius` in mm, sigma^2 (or
    Minnaert's exponent), strength of the highlight and the logarithm of its exponent.

    `position`, `normal`, `minnaert`, `roughness`, `exponent` are as in `factors_of_lamp`. `lights` (L, 5)
    hold unit direction, 1/distance (0 for a distant light) and intensity, `tangents` (L, 2, 3) derivatives of
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
