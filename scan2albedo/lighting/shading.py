"""The analytical skin reflectance model: ambient, diffuse and specular light of several point lights."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from scan2albedo.core import PointLight
from scan2albedo.core.arrays import ArrayLike, Float32Array, FloatArray, NDArray, all_finite, checked_array
from scan2albedo.core.compiled import compiled, triple
from scan2albedo.geometry.rigid import dot, minus

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
    x, y, z = np.asarray(direction, float) / np.linalg.norm(direction)
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
    view = np.asarray(view_direction, float)
    if view.shape not in ((3,), (count, 3)) or not all_finite(view) or not view.any(-1).all():
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


@compiled
def oren_nayar_coefficients(sigma):  # type: ignore[no-untyped-def]
    """Return A and B of Oren and Nayar, "Generalization of Lambert's reflectance model", 1994, eq. 30."""
    variance = sigma * sigma
    return 1.0 - 0.5 * variance / (variance + 0.33), 0.45 * variance / (variance + 0.09)


@compiled
def lamp_from(place, direction, nearness):  # type: ignore[no-untyped-def]
    """Return the vector from a place (3,) to a lamp in its distances, inside other compiled functions."""
    return minus(direction, (nearness * place[0], nearness * place[1], nearness * place[2]))


@compiled
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
        n, v = triple(normal, i), triple(view, i if view.shape[0] > 1 else 0)
        toward = lamp_from(triple(position, i), direction, nearness)
        n_l, n_v, l_v = dot(n, toward), dot(n, v), dot(toward, v)
        if n_l <= 0.0:
            continue
        square = max(dot(toward, toward), 1e-12)
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


class LitPoints(NamedTuple):
    """N points of a surface under L lamps, as `shade_with_derivatives` takes them.

    `position` (N, 3) mm; `normal` and `view` (N, 3) unit, `view` toward the viewer. `visible` (L, N) float32
    is the part of a lamp that reaches a point, 0 to 1, and `visible_slope` (L, 2, N) float32 its derivatives
    by the coordinates of the lamp's direction: an outline moves with the light. `specular_scale` (N,)
    multiplies the highlight.
    """

    position: FloatArray
    normal: FloatArray
    visible: Float32Array
    visible_slope: Float32Array
    view: FloatArray
    specular_scale: FloatArray


class FreeLamps(NamedTuple):
    """Lamps whose directions and intensities are free, and their common distance where it is `near`.

    `rows` (L, 5) hold unit direction, 1/distance (0 for a distant lamp) and intensity, `tangents` (L, 2, 3)
    the derivatives of each direction by its two coordinates. `radius_mm` / distance is the parameter of the
    distance.
    """

    rows: FloatArray
    tangents: FloatArray
    radius_mm: float
    near: bool


def shade_with_derivatives(
    points: LitPoints, lamps: FreeLamps, skin: Reflectance, size: int, *, rough: bool, glossy: bool
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return I = I_a + I_d (N,) with I_a = 1, I_s (N,), and the derivatives (2, N, `size`) of both.

    They are by the parameters of the light: for each lamp two coordinates of its direction and the logarithm
    of its intensity; then, where free, radius / distance, sigma^2 (or Minnaert's exponent) where `rough`,
    strength of the highlight and the logarithm of its exponent where `glossy`. The columns after them are 0.
    """
    look = skin.brdf == "minnaert", skin.roughness, skin.specular_strength, skin.exponent, rough, glossy
    light, specular, slopes = _shaded(tuple(points), tuple(lamps), look, size)
    return light, specular, slopes


@compiled(error_model="numpy")
def _shaded(points, lamps, skin, size):  # type: ignore[no-untyped-def]
    position, normal, visible, visible_slope, view, scale = points
    rows, tangents, radius_mm, near = lamps
    minnaert, roughness, specular, exponent, rough, glossy = skin
    oren_nayar = oren_nayar_coefficients(roughness)
    light_out, specular_out = np.empty(len(position)), np.empty(len(position))
    slopes = np.zeros((2, len(position), size))
    light_slope, specular_slope = slopes
    at_near = 3 * len(rows)
    at_rough = at_near + int(near)
    at_gloss = at_rough + int(rough)
    for i in range(len(position)):
        n = triple(normal, i)
        v = triple(view, i)
        n_v = dot(n, v)
        cos_r = max(n_v, 0.0)
        strength = specular * scale[i]
        light = 1.0
        gloss = 0.0
        for k in range(len(rows)):
            seen = visible[k, i]
            if seen == 0.0 and visible_slope[k, 0, i] == 0.0 and visible_slope[k, 1, i] == 0.0:
                continue
            nearness = rows[k, 3]
            toward = lamp_from(triple(position, i), triple(rows, k), nearness)
            length = np.sqrt(max(dot(toward, toward), 1e-12))
            n_l = dot(n, toward) / length
            if n_l <= 0.0:
                continue
            l_v = dot(toward, v) / length
            energy = rows[k, 4] / (length * length)
            diffuse = _diffuse(minnaert, roughness, oren_nayar, n_l, n_v, l_v)
            r_v = 0.0
            lobe = 0.0
            if glossy or specular > 0.0:
                r_v = min(2.0 * n_l * n_v - l_v, 1.0)
                if r_v > 0.0:
                    lobe = r_v**exponent
            light += seen * energy * diffuse
            gloss += seen * energy * lobe
            for q in range(3 if near else 2):
                if q < 2:
                    j = 3 * k + q
                    tangent = triple(tangents[k], q)
                else:
                    j = at_near
                    tangent = (
                        -position[i, 0] / radius_mm,
                        -position[i, 1] / radius_mm,
                        -position[i, 2] / radius_mm,
                    )
                stretch = dot(toward, tangent) / (length * length)
                n_l_slope = dot(n, tangent) / length - n_l * stretch
                l_v_slope = dot(v, tangent) / length - l_v * stretch
                if minnaert:
                    turned = roughness * diffuse / n_l * n_l_slope
                else:
                    turned = _oren_nayar_slope(oren_nayar, n_l, cos_r, l_v, n_l_slope, l_v_slope)
                light_slope[i, j] += seen * energy * (turned - 2.0 * diffuse * stretch)
                if q < 2:
                    light_slope[i, j] += visible_slope[k, q, i] * energy * diffuse
                if r_v > 0.0:
                    lobe_slope = exponent * lobe / max(r_v, 1e-9) * (2.0 * n_v * n_l_slope - l_v_slope)
                    specular_slope[i, j] += strength * seen * energy * (lobe_slope - 2.0 * lobe * stretch)
                    if q < 2:
                        specular_slope[i, j] += strength * visible_slope[k, q, i] * energy * lobe
            shine = strength * seen * energy * lobe
            light_slope[i, 3 * k + 2] += seen * energy * diffuse
            specular_slope[i, 3 * k + 2] += shine
            if rough and minnaert:
                light_slope[i, at_rough] += seen * energy * diffuse * np.log(n_l * max(n_v, COSINE_FLOOR))
            elif rough:
                light_slope[i, at_rough] += seen * energy * n_l * _variance_slope(roughness, n_l, cos_r, l_v)
            if glossy and r_v > 0.0:
                specular_slope[i, at_gloss] += scale[i] * seen * energy * lobe
                specular_slope[i, at_gloss + 1] += shine * exponent * np.log(max(r_v, 1e-12))
        light_out[i] = light
        specular_out[i] = strength * gloss
    return light_out, specular_out, slopes


@compiled(error_model="numpy")
def _diffuse(minnaert, roughness, oren_nayar, n_l, n_v, l_v):  # type: ignore[no-untyped-def]
    """Return f of `factors_of_lamp`."""
    if minnaert:
        return n_l**roughness * max(n_v, COSINE_FLOOR) ** (roughness - 1.0)
    a, b = oren_nayar
    cos_r = max(n_v, 0.0)
    return n_l * (a + b * max(l_v - n_l * cos_r, 0.0) / max(max(n_l, cos_r), COSINE_FLOOR))


@compiled(error_model="numpy")
def _oren_nayar_slope(oren_nayar, n_l, cos_r, l_v, n_l_slope, l_v_slope):  # type: ignore[no-untyped-def]
    """Return the derivative of Oren-Nayar's f from those of n.l and l.v."""
    a, b = oren_nayar
    s = max(l_v - n_l * cos_r, 0.0)
    s_slope = l_v_slope - cos_r * n_l_slope if s > 0.0 else 0.0
    if n_l >= cos_r and n_l > COSINE_FLOOR:
        return a * n_l_slope + b * s_slope
    larger = max(max(n_l, cos_r), COSINE_FLOOR)
    return n_l_slope * (a + b * s / larger) + n_l * b * s_slope / larger


@compiled(error_model="numpy")
def _variance_slope(sigma, n_l, cos_r, l_v):  # type: ignore[no-untyped-def]
    """Return the derivative of Oren-Nayar's f / n.l by sigma^2."""
    variance = sigma * sigma
    a_slope = -0.5 * 0.33 / (variance + 0.33) ** 2
    b_slope = 0.45 * 0.09 / (variance + 0.09) ** 2
    s = max(l_v - n_l * cos_r, 0.0)
    return a_slope + b_slope * s / max(max(n_l, cos_r), COSINE_FLOOR)


@compiled(error_model="numpy")
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
