"""Procedural albedo: wood, skin and a plain colour, evaluated at any texture coordinates."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from scan2albedo.core.arrays import FloatArray, smoothstep

_LIGHT_WOOD = np.array([0.62, 0.40, 0.22])
_DARK_WOOD = np.array([0.24, 0.11, 0.05])
_SKIN_TONES = np.array([[0.66, 0.42, 0.31], [0.60, 0.36, 0.25], [0.45, 0.25, 0.15], [0.28, 0.145, 0.085]])
MELANIN = np.array([0.45, 0.75, 1.0])
"""Relative absorption of melanin in red, green, blue."""
HEMOGLOBIN = np.array([0.12, 1.0, 0.85])
"""Relative absorption of blood in red, green, blue."""


def smooth_noise(uv: ArrayLike, cells: tuple[float, float], rng: np.random.Generator) -> FloatArray:
    """Return (N,) smooth noise of unit variance and period 1, with about `cells` bumps across u and v."""
    xy = np.asarray(uv, float)
    lattice = rng.normal(size=tuple(max(4, int(np.ceil(c))) for c in cells))
    coordinates = np.stack([xy[:, 0] * cells[0], xy[:, 1] * cells[1]])
    # Between lattice points a cubic spline through white noise keeps 0.866 of its standard deviation.
    return np.asarray(map_coordinates(lattice, coordinates, order=3, mode="grid-wrap") / 0.866)


def wood(uv: ArrayLike, rng: np.random.Generator, *, grain: float = 1.0) -> FloatArray:
    """Return (N, 3) linear albedo of a plank: about 14 / `grain` warped year rings and fibres along v."""
    xy = np.asarray(uv, float) / grain
    warp = 0.035 * smooth_noise(xy, (3, 2), rng) + 0.008 * smooth_noise(xy, (11, 4), rng)
    heart = np.array([0.35, -0.9]) + rng.uniform(-0.1, 0.1, 2)
    radius = np.hypot((xy[:, 0] - heart[0]) * 1.0, (xy[:, 1] - heart[1]) * 0.25) + warp
    phase = (radius * 22) % 1.0
    ring = np.where(phase < 0.8, phase / 0.8, (1 - phase) / 0.2)
    share = np.clip(0.15 + 0.6 * ring**1.5 + 0.13 * smooth_noise(xy, (160, 7), rng), 0, 1)[:, None]
    return np.clip(_LIGHT_WOOD * (1 - share) + _DARK_WOOD * share, 0.02, 0.95)


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
    base = np.array([np.interp(depth * 3, range(4), channel) for channel in _SKIN_TONES.T])
    scaled = xy / grain
    blood = 0.07 * smooth_noise(scaled, (5, 5), rng) + 0.05 * smooth_noise(scaled, (17, 17), rng)
    pigment = 0.05 * smooth_noise(scaled, (4, 4), rng) + 0.02 * smooth_noise(scaled, (40, 40), rng)
    pores = np.maximum(0, smooth_noise(scaled, (160, 160), rng)) * 0.06
    freckles = spots(xy, rng, count=int(rng.integers(40, 200)), radius=(0.002 * grain, 0.005 * grain))
    moles = spots(xy, rng, count=int(rng.integers(3, 9)), radius=(0.005 * grain, 0.009 * grain))
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


def spots(uv: FloatArray, rng: np.random.Generator, *, count: int, radius: tuple[float, float]) -> FloatArray:
    """Return (N,) 0 ... 1: soft-edged discs at random places, of random radii."""
    centers, radii = rng.uniform(size=(count, 2)), rng.uniform(*radius, size=count)
    distance, nearest = cKDTree(centers).query(uv)
    return smoothstep(1.3 - distance / radii[nearest])
