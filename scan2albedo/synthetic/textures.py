"""Procedural albedo at any texture coordinates: wood, plain, skin, and a face with brows, lips and eyes."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import resources

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree
from skimage.measure import points_in_poly

from scan2albedo.core.arrays import ArrayLike, BoolArray, FloatArray, arc_lengths, norms, smoothstep
from scan2albedo.errors import ModelError
from scan2albedo.face_model import AnnotatedSurface

_DATA = resources.files(__package__)
LOOKS = {
    name: np.array(values)
    for name, values in json.loads(_DATA.joinpath("data/looks.json").read_text("utf-8")).items()
}
"""Linear colours, relative absorption, and layers of noise: amplitude, and bumps across u and v, of each."""
RANGES = json.loads(_DATA.joinpath("data/ranges.json").read_text("utf-8"))
"""Least and greatest measures of painted features and of frames of glasses, by name."""
MELANIN = LOOKS["melanin"]
HEMOGLOBIN = LOOKS["hemoglobin"]
"""`MELANIN`, `HEMOGLOBIN`: relative absorption of the pigment and of blood in red, green, blue."""


def smooth_noise(uv: ArrayLike, cells: tuple[float, float], rng: np.random.Generator) -> FloatArray:
    """Return (N,) smooth noise of unit variance and period 1, with about `cells` bumps across u and v."""
    xy = np.asarray(uv, float)
    lattice = rng.normal(size=tuple(max(4, int(np.ceil(c))) for c in cells))
    coordinates = np.stack([xy[:, 0] * cells[0], xy[:, 1] * cells[1]])
    # Between lattice points a cubic spline through white noise keeps 0.866 of its standard deviation.
    return map_coordinates(lattice, coordinates, order=3, mode="grid-wrap") / 0.866


def layers(uv: ArrayLike, name: str, rng: np.random.Generator) -> FloatArray:
    """Return (N,) the sum of the layers of noise that `LOOKS` has under a name."""
    return np.asarray(sum(height * smooth_noise(uv, (u, v), rng) for height, u, v in LOOKS[name]))


def drawn(name: str, rng: np.random.Generator) -> dict[str, float]:
    """Return measures drawn uniformly from the `RANGES` of a name."""
    return {measure: float(rng.uniform(*limits)) for measure, limits in RANGES[name].items()}


def wood(uv: ArrayLike, rng: np.random.Generator, *, grain: float = 1.0) -> FloatArray:
    """Return (N, 3) linear albedo of a plank: about 14 / `grain` warped year rings and fibres along v."""
    xy = np.asarray(uv, float) / grain
    warp = layers(xy, "wood_warp", rng)
    heart = LOOKS["wood_heart"] + rng.uniform(-0.1, 0.1, 2)
    radius = np.hypot(xy[:, 0] - heart[0], (xy[:, 1] - heart[1]) * 0.25) + warp
    phase = (radius * 22) % 1.0
    ring = np.where(phase < 0.8, phase / 0.8, (1 - phase) / 0.2)
    share = np.clip(0.15 + 0.6 * ring**1.5 + 0.13 * smooth_noise(xy, (160, 7), rng), 0, 1)[:, None]
    return np.clip(LOOKS["light_wood"] * (1 - share) + LOOKS["dark_wood"] * share, 0.02, 0.95)


def skin(
    uv: ArrayLike,
    rng: np.random.Generator,
    *,
    grain: float = 1.0,
    tone: float | None = None,
    marks: bool = True,
) -> FloatArray:
    """Return (N, 3) linear albedo of bare skin: tone, blotches, pores, and with `marks` freckles and moles.

    Pigments absorb exponentially: ``tone exp(-melanin m - hemoglobin h)``. Pores are `grain` / 160 of the
    unit square wide; `tone` runs from 0, lightest, to 1, darkest, and is random when None.
    """
    xy = np.asarray(uv, float)
    depth = rng.uniform(0, 0.75) if tone is None else tone
    base = np.array([np.interp(depth * 3, range(4), channel) for channel in LOOKS["skin_tones"].T])
    scaled = xy / grain
    blood = layers(scaled, "blood", rng)
    pigment = layers(scaled, "pigment", rng)
    pores = np.maximum(0, smooth_noise(scaled, (160, 160), rng)) * 0.06
    freckles = spots(xy, rng, count=int(rng.integers(40, 200)), radius=grain * LOOKS["freckles"])
    moles = spots(xy, rng, count=int(rng.integers(3, 9)), radius=grain * LOOKS["moles"])
    pigment = pigment + pores + marks * (0.22 * freckles + 0.9 * moles)
    return np.clip(base * np.exp(-pigment[:, None] * MELANIN - blood[:, None] * HEMOGLOBIN), 0.01, 0.95)


def plain(uv: ArrayLike, rng: np.random.Generator, *, grain: float = 1.0) -> FloatArray:
    """Return (N, 3) linear albedo of one colour, with faint blotches of `grain` / 6 of the square."""
    xy = np.asarray(uv, float) / grain
    color = rng.uniform(0.25, 0.7, 3)
    return np.clip(color * (1 + 0.02 * smooth_noise(xy, (6, 6), rng))[:, None], 0.01, 0.95)


def painter(texture: str) -> Callable[..., FloatArray]:
    """Return what paints a texture by its name."""
    painters = {"plain": plain, "skin": skin, "wood": wood}
    if texture not in painters:
        raise ValueError(f"texture is {texture!r}, expected one of {sorted(painters)}")
    return painters[texture]


def spots(
    uv: FloatArray, rng: np.random.Generator, *, count: int, radius: Sequence[float] | FloatArray
) -> FloatArray:
    """Return (N,) 0 ... 1: soft-edged discs at random places, of random radii."""
    least, most = radius
    centers, radii = rng.uniform(size=(count, 2)), rng.uniform(least, most, count)
    distance, nearest = cKDTree(centers).query(uv)
    return smoothstep(1.3 - distance / radii[nearest])


@dataclass(frozen=True, kw_only=True)
class PaintedFeatures:
    """How brows and lips differ from those that the landmarks give; lengths in chart units (1 = 200 mm).

    `brow_thickness` is a factor; `brow_lift` and `brow_arch` move the brow and its middle upward;
    `brow_reach` is the share of the brow, from its inner end, that has hair; `lip_fullness` moves the lips'
    outline outward.
    """

    brow_thickness: float = 1.0
    brow_lift: float = 0.0
    brow_arch: float = 0.0
    brow_reach: float = 1.0
    lip_fullness: float = 0.0


def paint_face(
    uv: FloatArray,
    face: AnnotatedSurface | FloatArray,
    rng: np.random.Generator,
    *,
    grain: float = 1.0,
    tone: float | None = None,
    marks: bool = True,
    features: PaintedFeatures = PaintedFeatures(),
) -> FloatArray:
    """Return (N, 3) linear albedo of a face at chart coordinates (N, 2); other arguments as in `skin`.

    `face` is a model, or landmarks (68, 2) on any chart of that scale.
    """
    landmarks = landmark_uv(face) if isinstance(face, AnnotatedSurface) else face
    albedo = skin(uv, rng, grain=grain, tone=tone, marks=marks)
    pigment, blood = np.zeros(len(uv)), np.zeros(len(uv))
    for k in (31, 35):
        blood += rng.uniform(0.05, 0.3) * _blob(uv, landmarks[k] + [0.08 * np.sign(k - 33), 0.02], 0.06)
    blood += rng.uniform(0.05, 0.25) * _blob(uv, landmarks[30], 0.03)
    brows = rng.uniform(0.6, 0.9) * sum(
        _brow(uv, landmarks[side], rng, features) for side in (slice(17, 22), slice(22, 27))
    )
    # Redness of the lips, and darkness of the line between them.
    upper, lower = _curve(landmarks[48:55]), _curve(landmarks[[54, 55, 56, 57, 58, 59, 48]])
    inside = _signed_distance(uv, np.concatenate([upper, lower[1:-1]])) + features.lip_fullness
    lips = smoothstep(inside / 0.006 + 0.5)
    middle = (landmarks[[60, 61, 62, 63, 64]] + landmarks[[60, 67, 66, 65, 64]]) / 2
    line = smoothstep(1.5 - _distance(uv, _curve(middle)) / 0.004)
    blood += rng.uniform(0.5, 0.9) * lips * (1 + 0.08 * smooth_noise(uv, (220, 60), rng))
    pigment += 0.15 * lips + 0.9 * line
    albedo = albedo * np.exp(-pigment[:, None] * MELANIN - blood[:, None] * HEMOGLOBIN)
    albedo += (LOOKS["brow"] - albedo) * np.clip(brows, 0, 0.95)[:, None]
    iris = rng.choice(LOOKS["irises"])
    for corners in (landmarks[36:42], landmarks[42:48]):
        _paint_eye(albedo, uv, corners, iris, rng)
    return np.clip(albedo, 0.01, 0.95)


def _paint_eye(
    albedo: FloatArray, uv: FloatArray, corners: FloatArray, iris: FloatArray, rng: np.random.Generator
) -> None:
    """Paint ball, iris, pupil and lashes over albedo (N, 3) between the six landmarks of one eye."""
    upper = _curve(corners[:4])
    outline = np.concatenate([upper, _curve(corners[[3, 4, 5, 0]])[1:-1]])
    near = _near(uv, outline, 0.03)
    here = uv[near]
    opening = smoothstep(_signed_distance(here, outline) / 0.003 + 0.5)[:, None]
    width = np.linalg.norm(corners[3] - corners[0])
    from_pupil = norms(here - corners.mean(0) - [0, 0.04 * width]) / width
    ball = LOOKS["sclera"] * (1 + 0.02 * smooth_noise(here, (60, 60), rng))[:, None]
    rays = iris * (1 + 0.25 * smooth_noise(here, (300, 300), rng))[:, None]
    ball = ball + (rays - ball) * smoothstep((0.215 - from_pupil) / 0.02)[:, None]
    ball = ball * (1 - 0.9 * smoothstep((0.085 - from_pupil) / 0.02))[:, None]
    lashes = 1.8 * smoothstep(1.4 - _distance(here, upper) / 0.0045)
    painted = albedo[near] * (1 - opening) + ball * opening
    albedo[near] = painted * np.exp(-lashes[:, None] * MELANIN)


def landmark_uv(model: AnnotatedSurface) -> FloatArray:
    """Return (68, 2) chart coordinates of the model's landmarks."""
    points = model.landmark_points
    if points is None:
        raise ModelError(f"{model.name}: a painted face is placed by landmarks, but it has none")
    return np.einsum("nk,nkc->nc", points.barycentric, model.uv[model.control_faces[points.face]])


def _blob(uv: FloatArray, center: FloatArray, radius: float) -> FloatArray:
    return np.exp(-np.sum((uv - center) ** 2, axis=1) / (2 * radius**2))


def _curve(points: FloatArray) -> FloatArray:
    """Return 240 points of a natural cubic spline through (K, 2) points."""
    knots = arc_lengths(points)
    return CubicSpline(knots, points, bc_type="natural")(np.linspace(0, knots[-1], 240))


def _near(uv: FloatArray, points: FloatArray, margin: float) -> BoolArray:
    """Return (N,) which coordinates lie in the points' bounding box widened by `margin`."""
    return ((uv > points.min(0) - margin) & (uv < points.max(0) + margin)).all(1)


def _distance(uv: FloatArray, line: FloatArray) -> FloatArray:
    """Return (N,) distance to a polyline's points (K, 2), inf from 0.04 on."""
    return cKDTree(line).query(uv, distance_upper_bound=0.04)[0]


def _signed_distance(uv: FloatArray, outline: FloatArray) -> FloatArray:
    """Return (N,) distance to a closed polyline (K, 2), positive inside, -inf far outside."""
    signed = -_distance(uv, outline)
    near = _near(uv, outline, 0.0)
    signed[near] *= np.where(points_in_poly(uv[near], outline), -1, 1)
    return signed


def _brow(
    uv: FloatArray, landmarks: FloatArray, rng: np.random.Generator, features: PaintedFeatures
) -> FloatArray:
    """Return (N,) density of brow hair around the five landmarks of one brow."""
    arch = features.brow_arch * np.array([0.0, 0.7, 1.0, 0.7, 0.0])
    line = _curve(landmarks + np.stack([np.zeros(5), features.brow_lift + arch - 0.006], 1))
    density, near = np.zeros(len(uv)), _near(uv, line, 0.04)
    distance, nearest = cKDTree(line).query(uv[near])
    outward = nearest / (len(line) - 1)
    if landmarks[0, 0] < landmarks[-1, 0]:
        outward = 1 - outward
    width = 0.021 * features.brow_thickness * np.sqrt(np.clip(1.12 - outward, 0.05, 1))
    strands = 1 + 0.35 * smooth_noise(uv[near] @ np.array([[1, 0.6], [-0.6, 1]]), (240, 90), rng)
    density[near] = smoothstep(1.6 * (1 - distance / width)) * np.clip(strands, 0.2, 1.5)
    if features.brow_reach < 1:
        density[near] *= smoothstep((features.brow_reach - outward) / 0.15 + 0.5)
    return density
