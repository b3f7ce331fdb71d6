"""The analytical skin reflectance model: ambient, diffuse and specular light of several point lights."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from scan2albedo.core import PointLight
from scan2albedo.core.arrays import ArrayLike, FloatArray, NDArray, all_finite, checked_array, dots
from scan2albedo.core.compiled import compiled

COSINE_FLOOR = 1e-4
"""Cosines below this count as this where a model divides by them."""
_CLOSEST = 1e-6
"""Parts of its distance from the origin to which a lamp comes near a point."""


class Parameter(NamedTuple):
    """A number that a search for the light may free: where it starts, its bounds, first step, and prior."""

    start: float
    lower: float
    upper: float
    step: float
    mean: float
    deviation: float
    plain: float = 0.0
    """The value at which what it stands for is not there."""


Lobe = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""(L, N) a reflectance f and its derivatives by n.l, by l.v and by its own parameter."""


class DiffuseModel(NamedTuple):
    """A diffuse reflectance, chosen as `brdf` by its name in `DIFFUSE_MODELS`."""

    lobe: Callable[[FloatArray, FloatArray, FloatArray, float], Lobe]
    """Of the cosines n.l > 0 (L, N), n.v (N,), l.v (L, N), and the roughness."""
    roughness_name: str = "roughness"
    """Of the roughness in files of results."""
    roughness: Parameter | None = None
    """The parameter; None where there is none."""
    power: float = 1.0
    """The roughness is the parameter to this power."""

    @property
    def plain(self) -> float:
        """The roughness at which the surface looks the same from everywhere."""
        return 0.0 if self.roughness is None else self.roughness.plain


def _lambert(n_l: FloatArray, n_v: FloatArray, l_v: FloatArray, roughness: float) -> Lobe:
    nothing = np.zeros_like(n_l)
    return n_l, np.ones_like(n_l), nothing, nothing


def _oren_nayar(n_l: FloatArray, n_v: FloatArray, l_v: FloatArray, roughness: float) -> Lobe:
    """cos_i (A + B s / max(cos_i, cos_r)), s = max(0, l.v - cos_i cos_r): neither azimuth nor tangent [1]_.

    .. [1] M. Oren, S. Nayar, "Generalization of Lambert's reflectance model", SIGGRAPH 1994, eq. 30.
    """
    variance = roughness * roughness
    a = 1 - 0.5 * variance / (variance + 0.33)
    b = 0.45 * variance / (variance + 0.09)
    cos_r = np.maximum(n_v, 0.0)
    larger = np.maximum(np.maximum(n_l, cos_r), COSINE_FLOOR)
    s = np.maximum(l_v - n_l * cos_r, 0.0)
    ratio = s / larger
    of_s = n_l / larger * (s > 0)
    by_n_l = a + b * (ratio * (n_l < larger) - cos_r * of_s)
    by_variance = n_l * (0.45 * 0.09 / (variance + 0.09) ** 2 * ratio - 0.5 * 0.33 / (variance + 0.33) ** 2)
    return n_l * (a + b * ratio), by_n_l, b * of_s, by_variance


def _minnaert(n_l: FloatArray, n_v: FloatArray, l_v: FloatArray, roughness: float) -> Lobe:
    """cos_i^k cos_r^(k - 1)."""
    cos_r = np.maximum(n_v, COSINE_FLOOR)
    f = n_l**roughness * cos_r ** (roughness - 1)
    return f, roughness * f / n_l, np.zeros_like(f), f * np.log(n_l * cos_r)


def _phong(n_l: FloatArray, n_v: FloatArray, l_v: FloatArray, exponent: float) -> Lobe:
    """(r.v)^m, 0 where the mirrored light points away from the viewer; the last derivative is by log m."""
    r_v = np.clip(2 * n_l * n_v - l_v, 0.0, 1.0)
    f = np.where(r_v > 0, r_v**exponent, 0.0)
    logs = np.log(np.maximum(r_v, 1e-12))
    steep = exponent * f / np.maximum(r_v, 1e-9)
    return f, 2 * n_v * steep, -steep, exponent * f * logs


DIFFUSE_MODELS = {
    # Skin has a variance of the facets of some .1: S. Marschner et al., "Image-based BRDF measurement
    # including human skin", EGWR 1999.
    "oren-nayar": DiffuseModel(_oren_nayar, "sigma_rad", Parameter(0.04, 0.0, 1.0, 0.04, 0.1, 0.1), 0.5),
    "lambert": DiffuseModel(_lambert, "sigma_rad"),
    "minnaert": DiffuseModel(_minnaert, "minnaert_exponent", Parameter(1.0, 0.3, 2.0, 0.2, 1.0, 0.2, 1.0)),
}
"""The diffuse reflectances by the names that `brdf` takes; another one is one more entry.

Oren-Nayar's roughness is sigma in radians (0 is Lambert), and its parameter sigma^2; Minnaert's roughness is
his exponent (1 is Lambert).
"""


@dataclass(frozen=True)
class Reflectance:
    """How the surface reflects; the albedo is not part of it.

    `brdf` is one of `DIFFUSE_MODELS`, which says what `roughness` is. `specular_strength` is Phong's k_s for
    a light of intensity 1, in the unit of the texture; `exponent` is Phong's m. ValueError for an unknown
    `brdf`, rough Lambert, or a number that is negative or not finite.
    """

    brdf: str = "oren-nayar"
    roughness: float = 0.0
    specular_strength: float = 0.0
    exponent: float = 16.0

    def __post_init__(self) -> None:
        if self.brdf not in DIFFUSE_MODELS:
            raise ValueError(f"brdf is {self.brdf!r}, expected one of {tuple(DIFFUSE_MODELS)}")
        if self.model.roughness is None and self.roughness != 0:
            raise ValueError(f"a surface that is {self.brdf} has roughness 0, got {self.roughness}")
        for name in ("roughness", "specular_strength", "exponent"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} is {getattr(self, name)}, expected a finite number, 0 or more")

    @property
    def model(self) -> DiffuseModel:
        """The diffuse reflectance."""
        return DIFFUSE_MODELS[self.brdf]

    def parameters(self) -> dict[str, object]:
        """Return the numbers by their names in files of results."""
        return {
            "brdf": self.brdf,
            self.model.roughness_name: self.roughness,
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
    colors = np.reshape([lamp.color_linear for lamp in lights], (-1, 3))
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
    tint = np.ones((len(rows), 3)) if colors is None else colors
    lamps, highlights = lamp_factors(position, normal, visible, rows, view, reflectance) * rows[:, 4:]
    strength = reflectance.specular_strength * scale
    specular = strength[:, None] * (highlights.T @ tint)
    return Shading(1 + lamps.sum(0), strength * highlights.sum(0), 1 + lamps.T @ tint, specular, lamps)


def lamp_factors(
    position: FloatArray,
    normal: FloatArray,
    visible: NDArray,
    rows: FloatArray,
    view: FloatArray,
    reflectance: Reflectance,
) -> FloatArray:
    """Return (2, L, N) what multiplies a lamp's intensity in light on the albedo, in highlights of k_s = 1.

    That is f / r^2 and (r.v)^m / r^2, r in the lamp's distances, times the part `visible` (L, N) of it.
    """
    cosines = _Cosines(position, normal, np.atleast_2d(view), rows)
    known = cosines.n_l, cosines.n_v, cosines.l_v
    factors = np.zeros((2, *cosines.n_l.shape))
    factors[0] = reflectance.model.lobe(*known, reflectance.roughness)[0]
    if reflectance.specular_strength > 0:
        factors[1] = _phong(*known, reflectance.exponent)[0]
    return factors * (visible * cosines.falloff)


class _Cosines:
    """Of N points under L lamps: n.l (L, N), 1 where it is not above 0, n.v (N,) and l.v (L, N).

    `distance` (L, N) is in those of the lamps from the origin; `falloff` is 1 / distance^2 where n.l > 0.
    """

    def __init__(self, position: FloatArray, normal: FloatArray, view: FloatArray, rows: FloatArray) -> None:
        direction, nearness = rows[:, :3], rows[:, 3:4]
        outward = dots(position, position)
        square = 1 - 2 * nearness * (direction @ position.T) + nearness**2 * outward
        self.distance = np.sqrt(np.maximum(square, _CLOSEST**2))
        cosine = (direction @ normal.T - nearness * dots(position, normal)) / self.distance
        facing = cosine > 0
        self.n_l = np.where(facing, cosine, 1.0)
        self.n_v = dots(normal, view)
        self.l_v = (direction @ view.T - nearness * dots(position, view)) / self.distance
        self.falloff = facing / self.distance**2


class LitPoints(NamedTuple):
    """N points of a surface under L lamps, as `shade_with_derivatives` takes them.

    `position` (N, 3) mm; `normal` and `view` (N, 3) unit, `view` toward the viewer. `visible` (L, N) float32
    is the part of a lamp that reaches a point, 0 to 1, and `visible_slope` (L, 2, N) float32 its derivatives
    by the coordinates of the lamp's direction: an outline moves with the light. `specular_scale` (N,)
    multiplies the highlight.
    """

    position: FloatArray
    normal: FloatArray
    visible: NDArray
    visible_slope: NDArray
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


@compiled
def _chain(points, lamps, distance, n_l, l_v, reaching, lobe, part, slope):  # type: ignore[no-untyped-def]
    """Fill `part` (L, N), each lamp's light, and its derivatives `slope` (N, P) by directions and distance.

    `distance`, `n_l` and `l_v` (L, N) are those of `_Cosines`; `reaching` (L, N) is what multiplies the
    `lobe` (4, L, N).
    """
    position, normal, visible, visible_slope, view, _ = points
    rows, tangents, radius, near = lamps
    count = len(rows)
    for k in range(count):
        for i in range(len(position)):
            if reaching[k, i] == 0.0:
                part[k, i] = 0.0
                continue
            f, by_n_l, by_l_v = lobe[0, k, i], lobe[1, k, i], lobe[2, k, i]
            length = distance[k, i]
            part[k, i] = visible[k, i] * reaching[k, i] * f
            slope[i, 3 * k + 2] = part[k, i]
            for q in range(3 if near else 2):
                along = 0.0
                up = 0.0
                toward = 0.0
                for c in range(3):
                    moved = tangents[k, q, c] if q < 2 else -position[i, c] / radius
                    along += moved * (rows[k, c] - rows[k, 3] * position[i, c])
                    up += moved * normal[i, c]
                    toward += moved * view[i, c]
                stretch = along / length**2
                turned = by_n_l * (up / length - n_l[k, i] * stretch)
                turned += by_l_v * (toward / length - l_v[k, i] * stretch)
                by_light = visible[k, i] * (turned - 2 * f * stretch)
                if q < 2:
                    by_light += visible_slope[k, q, i] * f
                column = 3 * k + q if q < 2 else 3 * count
                slope[i, column] += reaching[k, i] * by_light


def shade_with_derivatives(
    points: LitPoints, lamps: FreeLamps, skin: Reflectance, size: int, *, rough: bool, glossy: bool
) -> tuple[FloatArray, FloatArray]:
    """Return each lamp's part (2, L, N) of diffuse and specular light, and the derivatives (2, N, `size`).

    They are by the parameters of the light: for each lamp two coordinates of its direction and the logarithm
    of its intensity; then, where free, radius / distance, that of `DiffuseModel` where `rough`, strength of
    the highlight and the logarithm of its exponent where `glossy`. The columns after them are 0.
    """
    cosines = _Cosines(points.position, points.normal, points.view, lamps.rows)
    energy = lamps.rows[:, 4:] * cosines.falloff
    parts = np.empty((2, *energy.shape))
    slopes = np.zeros((2, len(points.position), size))
    known = cosines.n_l, cosines.n_v, cosines.l_v
    lobes = np.array([skin.model.lobe(*known, skin.roughness), _phong(*known, skin.exponent)])
    reaching = np.array([energy, energy * skin.specular_strength * points.specular_scale])
    for part, slope, lobe, reached in zip(parts, slopes, lobes, reaching, strict=True):
        _chain(points, lamps, cosines.distance, cosines.n_l, cosines.l_v, reached, lobe, part, slope)
    by_own = (points.visible * reaching * lobes[:, 3]).sum(1)
    column = 3 * len(lamps.rows) + int(lamps.near)
    if rough:
        slopes[0][:, column] = by_own[0]
        column += 1
    if glossy:
        slopes[1][:, column] = points.specular_scale * (energy * points.visible * lobes[1, 0]).sum(0)
        slopes[1][:, column + 1] = by_own[1]
    return parts, slopes
