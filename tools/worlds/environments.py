"""Environment maps: everyday places at random, the model of light learned from them, a studio, a sky.

Rows go from +y down to -y, columns by azimuth from -pi to pi, from +z toward +x.
"""

import numpy as np

from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.lighting.environment import (
    DistantLights,
    map_directions,
    texel_directions,
    texel_solid_angles,
)
from scan2albedo.lighting.harmonics import row_projection
from scan2albedo.reflectance import LightingModel

SHAPE = (32, 64)
"""Rows and columns: finer than harmonics of order 8 resolve."""


def generated_lighting(*, count: int = 600, components: int = 80) -> LightingModel:
    """Learn a model of `components` directions from `count` maps of `generated_environment`."""
    rng = np.random.default_rng(0)
    projection = np.concatenate([row_projection(row, SHAPE) for row in range(SHAPE[0])]).T
    maps = (generated_environment(rng).reshape(-1, 3) for _ in range(count))
    lights = np.stack([projection @ image for image in maps])
    return LightingModel.from_coefficients(lights, components=components)


def generated_environment(seed: int | np.random.Generator) -> FloatArray:
    """Return a map (32, 64, 3) of linear radiance: a sky, a room with windows, one with lamps, or a studio.

    All azimuths are equally likely. The same `seed` gives the same map.
    """
    rng = np.random.default_rng(seed)
    place = (_open_sky, _windows, _lamps, _dark_studio)[int(rng.choice(4, p=[0.3, 0.3, 0.25, 0.15]))]
    return place(rng, texel_directions(SHAPE))


def _open_sky(rng: np.random.Generator, toward: FloatArray) -> FloatArray:
    """Gradient from zenith to horizon, a sun that clouds may cover, ground, and things on the horizon."""
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


def _windows(rng: np.random.Generator, toward: FloatArray) -> FloatArray:
    """Walls that are lit through one to four windows."""
    image = _room(rng, toward, rng.uniform(0.05, 0.5))
    day = _color(rng.uniform(5000, 10000))
    for _ in range(rng.integers(1, 5)):
        low = rng.uniform(-0.5, 0.1)
        window = _panel(toward, rng, low=low, high=low + rng.uniform(0.4, 1.1), widest=1.0)
        image = np.where(window[..., None], day * rng.uniform(2, 15), image)
    return image


def _lamps(rng: np.random.Generator, toward: FloatArray) -> FloatArray:
    """A room at night with one to six lamps, most of them above."""
    image = _room(rng, toward, rng.uniform(0.02, 0.3))
    color = _color(rng.choice([1900, 2800, 4200, 6000]))  # candles, tungsten, neutral, daylight
    for _ in range(rng.integers(1, 7)):
        lamp = map_directions(np.arccos(rng.uniform(-0.3, 1.0)), rng.uniform(-np.pi, np.pi))
        strength = rng.uniform(2, 30)
        image = image + strength * _blob(toward, lamp, rng.uniform(0.08, 0.3))[..., None] * color
    return image


def _dark_studio(rng: np.random.Generator, toward: FloatArray) -> FloatArray:
    """A dark studio with a key light, a fill and a rim light of free colours, from all sides."""
    image = _room(rng, toward, rng.uniform(0.01, 0.1))
    for strength in rng.uniform(0.5, 12, rng.integers(1, 4)):
        light = map_directions(rng.uniform(0.2, 2.4), rng.uniform(-np.pi, np.pi))
        color = _color(rng.uniform(2500, 9000)) * rng.uniform(0.6, 1.4, 3)
        image = image + strength * _blob(toward, light, rng.uniform(0.15, 0.6))[..., None] * color
    return image


def _room(rng: np.random.Generator, toward: FloatArray, brightness: float) -> FloatArray:
    """Four walls, floor and ceiling, each of one colour."""
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
) -> BoolArray:
    """Mask of the pixels between two heights and two azimuths."""
    azimuth = np.arctan2(toward[..., 0], toward[..., 2])
    off = np.abs((azimuth - rng.uniform(-np.pi, np.pi) + np.pi) % (2 * np.pi) - np.pi)
    return np.asarray((off < rng.uniform(0.15, widest)) & (toward[..., 1] > low) & (toward[..., 1] < high))


def _blob(toward: FloatArray, centre: FloatArray, width_rad: float) -> FloatArray:
    """A smooth spot of value 1 at its centre."""
    return np.asarray(np.exp((toward @ centre - 1) / width_rad**2))


def _surface(rng: np.random.Generator) -> FloatArray:
    """Colour of paint, wood, grass or stone: a grey with some hue."""
    return np.asarray(rng.uniform(0.15, 0.8) * rng.uniform(0.7, 1.3, 3))


def _color(kelvin: float) -> FloatArray:
    """Linear sRGB of a black body, of mean 1: Planck's law at 610, 550 and 465 nm, relative to 6500 K."""
    body, white = 1 / np.expm1(1.4388e7 / (np.array([610.0, 550.0, 465.0]) * [[kelvin], [6500.0]]))
    return np.asarray(body / white / (body / white).mean())


def studio(rows: int = 128) -> FloatArray:
    """Return a dim room (rows, 2 rows, 3) with three softboxes with sharp edges."""
    toward = texel_directions((rows, 2 * rows))
    image = np.full((rows, 2 * rows, 3), 0.08)
    for way, half, color in (
        ((-0.7, 0.5, 0.6), (0.30, 0.22), (9.0, 8.6, 8.0)),
        ((0.9, 0.1, 0.4), (0.15, 0.45), (2.5, 2.7, 3.2)),
        ((0.2, 0.9, 0.1), (0.4, 0.1), (4.0, 4.0, 4.0)),
    ):
        axis = np.array(way) / np.linalg.norm(way)
        side = np.cross([0.0, 1, 0.0], axis)
        side /= np.linalg.norm(side)
        up, depth = np.cross(axis, side), toward @ axis
        inside = (np.abs(toward @ side) < half[0] * depth) & (np.abs(toward @ up) < half[1] * depth)
        image[inside] = color
    return image


def sky(rows: int = 128) -> FloatArray:
    """Return a hazy sky (rows, 2 rows, 3) over dark ground, the sun's disc six degrees wide."""
    toward = texel_directions((rows, 2 * rows))
    height = toward[..., 1]
    image = np.where(height[..., None] > 0, [0.35, 0.5, 0.9], [0.12, 0.1, 0.08]).astype(float)
    image += np.clip(1 - np.abs(height), 0, 1)[..., None] ** 4 * 0.3
    sun = np.array([0.5, 0.7, 0.6]) / np.linalg.norm([0.5, 0.7, 0.6])
    image += np.where(toward @ sun > np.cos(np.deg2rad(3.0)), 120.0, 0.0)[..., None] * [1.0, 0.95, 0.85]
    return image


ENVIRONMENTS = {"studio": studio, "sky": sky}


def reference_lights(environment: FloatArray) -> DistantLights:
    """Return 8,192 lights drawn by brightness, stratified and jittered, each of radiance over density.

    It shares nothing with the lights that are measured: no lattice, no cells.
    """
    count = 8192
    rows, columns = environment.shape[:2]
    edges = np.cos(np.arange(rows + 1) * np.pi / rows)
    size = np.repeat(texel_solid_angles(rows, columns), columns)
    flat = environment.reshape(-1, 3)
    share = flat.mean(1) * size
    share = 0.7 * share / share.sum() + 0.3 * size / size.sum()
    rng = np.random.default_rng(0)
    drawn = np.searchsorted(np.cumsum(share), (np.arange(count) + rng.random(count)) / count)
    drawn = np.minimum(drawn, len(share) - 1)
    row, column = np.divmod(drawn, columns)
    y = edges[row] + rng.random(count) * (edges[row + 1] - edges[row])
    azimuth = ((column + rng.random(count)) / columns - 0.5) * 2 * np.pi
    across = np.sqrt(np.maximum(1 - y * y, 0))
    toward = np.stack([across * np.sin(azimuth), y, across * np.cos(azimuth)], 1)
    return DistantLights(toward, flat[drawn] * (size / share / count)[drawn, None])
