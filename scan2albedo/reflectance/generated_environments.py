"""Environment maps drawn at random: skies, rooms with windows, rooms with lamps, studios."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from scan2albedo.lighting.environment_harmonics import map_directions

FloatArray = NDArray[np.float64]

SHAPE = (32, 64)
"""Rows and columns: finer than harmonics of order 8 can tell."""

_KELVIN = {"candle": 1900.0, "tungsten": 2800.0, "neutral": 4200.0, "daylight": 6000.0, "shade": 9000.0}


def generated_environment(seed: int | np.random.Generator) -> FloatArray:
    """Return a map (32, 64, 3) of linear radiance, drawn from four kinds of places.

    Rows from +y down to -y, columns by azimuth from -pi to pi, from +z toward +x; no azimuth is likelier than
    another. The same seed gives the same map.

    Parameters
    ----------
    seed : int or numpy.random.Generator

    Examples
    --------
    >>> image = generated_environment(0)
    >>> image.shape, bool(image.min() > 0)
    ((32, 64, 3), True)
    """
    rng = np.random.default_rng(seed)
    kinds: tuple[Callable[[np.random.Generator], FloatArray], ...] = (_sky, _windows, _lamps, _studio)
    return kinds[int(rng.choice(len(kinds), p=[0.3, 0.3, 0.25, 0.15]))](rng)


def _sky(rng: np.random.Generator) -> FloatArray:
    """Gradient from zenith to horizon, a sun that clouds may cover, ground, and things on the horizon."""
    toward = _directions()
    up = toward[..., 1]
    horizon, zenith = _color(rng.uniform(4500, 7500)), _color(rng.uniform(7000, 14000))
    blend = np.clip(up, 0, 1)[..., None] ** rng.uniform(0.3, 0.9)
    sky = (1 - blend) * horizon * rng.uniform(0.8, 1.8) + blend * zenith * rng.uniform(0.4, 1.0)
    cover = rng.uniform()
    elevation = np.arcsin(rng.uniform(0.05, 0.98))
    sun = map_directions(np.pi / 2 - elevation, rng.uniform(-np.pi, np.pi))
    warmth = _color(2500 + 3300 * np.sin(elevation) ** 0.5)
    glow = _blob(toward, sun, rng.uniform(0.1, 0.25))[..., None] * rng.uniform(5, 60) * (1 - cover) ** 2
    halo = _blob(toward, sun, rng.uniform(0.4, 0.8))[..., None] * rng.uniform(0.2, 2.0)
    ground = _surface(rng) * rng.uniform(0.2, 1.0)
    image = np.where(up[..., None] > 0, sky + (glow + halo) * warmth, ground)
    for _ in range(rng.integers(0, 5)):
        block = _panel(toward, rng, low=-0.1, high=rng.uniform(0.1, 0.7), widest=1.2)
        image = np.where(block[..., None], _surface(rng) * rng.uniform(0.05, 0.8), image)
    return image


def _windows(rng: np.random.Generator) -> FloatArray:
    """A room whose walls are lit through one to four windows."""
    toward, image = _directions(), _room(rng, rng.uniform(0.05, 0.5))
    day = _color(rng.uniform(5000, 10000))
    for _ in range(rng.integers(1, 5)):
        low = rng.uniform(-0.5, 0.1)
        window = _panel(toward, rng, low=low, high=low + rng.uniform(0.4, 1.1), widest=1.0)
        image = np.where(window[..., None], day * rng.uniform(2, 15), image)
    return image


def _lamps(rng: np.random.Generator) -> FloatArray:
    """A room at night with one to six lamps, most of them above."""
    toward, image = _directions(), _room(rng, rng.uniform(0.02, 0.3))
    color = _color(_KELVIN[str(rng.choice(["candle", "tungsten", "neutral", "daylight"]))])
    for _ in range(rng.integers(1, 7)):
        lamp = map_directions(np.arccos(rng.uniform(-0.3, 1.0)), rng.uniform(-np.pi, np.pi))
        strength = rng.uniform(2, 30)
        image = image + strength * _blob(toward, lamp, rng.uniform(0.08, 0.3))[..., None] * color
    return image


def _studio(rng: np.random.Generator) -> FloatArray:
    """A dark studio with a key light, a fill and a rim light of free colours, from all sides."""
    toward, image = _directions(), _room(rng, rng.uniform(0.01, 0.1))
    for strength in rng.uniform(0.5, 12, rng.integers(1, 4)):
        light = map_directions(rng.uniform(0.2, 2.4), rng.uniform(-np.pi, np.pi))
        color = _color(rng.uniform(2500, 9000)) * rng.uniform(0.6, 1.4, 3)
        image = image + strength * _blob(toward, light, rng.uniform(0.15, 0.6))[..., None] * color
    return image


def _room(rng: np.random.Generator, brightness: float) -> FloatArray:
    """Four walls, floor and ceiling, each of one colour."""
    toward = _directions()
    turn = rng.uniform(0, np.pi / 2)
    x = np.cos(turn) * toward[..., 0] + np.sin(turn) * toward[..., 2]
    z = -np.sin(turn) * toward[..., 0] + np.cos(turn) * toward[..., 2]
    box = np.stack([x, toward[..., 1] * rng.uniform(1.0, 2.5), z], -1)
    axis = np.abs(box).argmax(-1)
    side = np.take_along_axis(box, axis[..., None], -1)[..., 0] > 0
    colors = np.stack([_surface(rng) for _ in range(6)])
    colors[3] = 0.5 + 0.5 * colors[3]  # ceilings are pale
    return brightness * rng.uniform(0.5, 1.5, 6)[2 * axis + side][..., None] * colors[2 * axis + side]


def _panel(
    toward: FloatArray, rng: np.random.Generator, *, low: float, high: float, widest: float
) -> NDArray[np.bool_]:
    """Mask of what lies between two heights and two azimuths."""
    azimuth = np.arctan2(toward[..., 0], toward[..., 2])
    off = np.abs((azimuth - rng.uniform(-np.pi, np.pi) + np.pi) % (2 * np.pi) - np.pi)
    inside: NDArray[np.bool_] = (
        (off < rng.uniform(0.15, widest)) & (toward[..., 1] > low) & (toward[..., 1] < high)
    )
    return inside


def _blob(toward: FloatArray, centre: FloatArray, width_rad: float) -> FloatArray:
    """A smooth spot of value 1 at its centre."""
    return np.asarray(np.exp((toward @ centre - 1) / width_rad**2))


def _surface(rng: np.random.Generator) -> FloatArray:
    """Colour of paint, wood, grass or stone: a grey with some hue."""
    return np.asarray(rng.uniform(0.15, 0.8) * rng.uniform(0.7, 1.3, 3))


def _color(kelvin: float) -> FloatArray:
    """Linear sRGB of a black body, of mean 1: Planck's law at 610, 550 and 465 nm, relative to 6500 K."""

    def planck(temperature: float) -> FloatArray:
        x = 1.4388e7 / (np.array([610.0, 550.0, 465.0]) * temperature)
        return 1 / np.expm1(x)

    ratio = planck(kelvin) / planck(6500.0)
    return np.asarray(ratio / ratio.mean())


def _directions() -> FloatArray:
    height, width = SHAPE
    polar = (np.arange(height)[:, None] + 0.5) * np.pi / height
    return map_directions(polar, ((np.arange(width) + 0.5) / width - 0.5) * 2 * np.pi)
