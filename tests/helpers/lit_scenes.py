"""Small scenes with known albedo, rendered by plain NumPy that shares nothing with the estimator."""

import math
from dataclasses import dataclass
from functools import cache
from itertools import starmap

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from scan2albedo.albedo import EstimateOptions, albedo_error
from scan2albedo.albedo.levels import usable_texels
from scan2albedo.albedo.lit_image import LitImage
from scan2albedo.albedo.prior import AlbedoPrior
from scan2albedo.core import Budget, Meter
from scan2albedo.core.geometry_image import GeometryImage


@dataclass(frozen=True)
class Scene:
    image: GeometryImage
    albedo_linear: np.ndarray
    light_directions: np.ndarray


def direction(azimuth_deg, elevation_deg=0.0):
    az, el = math.radians(azimuth_deg), math.radians(elevation_deg)
    return np.array([math.cos(el) * math.sin(az), math.sin(el), math.cos(el) * math.cos(az)])


def angle_deg(light, toward):
    """Return the angle of a light to a direction."""
    return math.degrees(math.acos(min(1.0, float(light.direction @ toward))))


def percent_off(estimate, scene):
    """Return the error of an estimated albedo, 100 times the mean square."""
    return albedo_error(estimate.albedo_linear, scene.albedo_linear, scene.image.mask).mse_percent


def hemisphere_geometry(size, radius_mm=80.0):
    """Equal-area disc chart of a hemisphere around +z."""
    axis = (np.arange(size) + 0.5) / size * 2 - 1
    u, v = np.meshgrid(axis, -axis)
    rho = np.hypot(u, v)
    mask = rho < 0.98
    z = 1 - np.minimum(rho, 1) ** 2
    ring = np.sqrt(np.maximum(1 - z**2, 0)) / np.maximum(rho, 1e-9)
    normal = np.stack([u * ring, v * ring, z], -1) * mask[..., None]
    return radius_mm * normal, normal, mask


def bumps_geometry(size, half_mm=90.0):
    """Height field with a ridge and hills that shade one another."""
    axis = ((np.arange(size) + 0.5) / size * 2 - 1) * half_mm
    x, y = np.meshgrid(axis, -axis)
    hills = [
        (0, 5, 30, 9, 26),
        (-38, 30, 14, 20, 15),
        (38, 30, 14, 20, 15),
        (0, -45, 14, 28, 14),
        (0, 0, 55, 70, 85),
    ]
    cx, cy, height, sx, sy = np.array(hills).T[..., None, None]
    hill = height * np.exp(-0.5 * (((x - cx) / sx) ** 2 + ((y - cy) / sy) ** 2))
    falls = [(hill * (x - cx) / sx**2).sum(0), (hill * (y - cy) / sy**2).sum(0)]
    normal = np.stack([*falls, np.ones_like(x)], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.stack([x, y, hill.sum(0) - 30], -1), normal, np.ones_like(x, bool)


def march_shadow(position, light_point_or_direction, distant, steps=400):
    """Height-field shadow by marching toward the light over the bilinear surface."""
    size = position.shape[0]
    x, y, z = np.moveaxis(position, -1, 0)
    pitch = x[0, 1] - x[0, 0]
    toward = light_point_or_direction if distant else light_point_or_direction - position
    toward = np.broadcast_to(toward, position.shape)
    toward = toward / np.linalg.norm(toward, axis=-1, keepdims=True)
    visible = np.ones((size, size), bool)
    for t in np.linspace(0.4, 140, steps):
        px, py, pz = (position + t * toward).transpose(2, 0, 1)
        column, row = (px - x[0, 0]) / pitch, (y[0, 0] - py) / pitch
        inside = (column >= 0) & (column <= size - 1) & (row >= 0) & (row <= size - 1)
        height = map_coordinates(z, [row, column], order=1, mode="nearest")
        visible &= ~(inside & (pz < height - 0.02))
    return visible


def texture(kind, size, seed=0):
    rng = np.random.default_rng(seed)
    u, v = np.meshgrid(*[np.linspace(0, 1, size)] * 2)
    if kind == "plain":
        value = np.full((size, size), 0.55)
    elif kind == "wood":
        warp = gaussian_filter(rng.standard_normal((size, size)), size / 12)
        warp /= warp.std()
        value = (
            0.5
            + 0.16 * np.sin(2 * np.pi * (14 * u + 1.1 * warp))
            + 0.04 * np.sin(2 * np.pi * 43 * (u + 0.1 * v))
        )
    else:
        fine = gaussian_filter(rng.standard_normal((size, size)), size / 250)
        spots = gaussian_filter(rng.standard_normal((size, size)), size / 40)
        value = 0.55 + 0.04 * fine / fine.std() + 0.05 * spots / spots.std()
    tint = {"plain": [1, 1, 1], "wood": [1, 0.7, 0.45], "skin": [1, 0.72, 0.6]}[kind]
    return np.clip(value, 0.05, 0.95)[..., None] * np.array(tint)


def _lamp(azimuth_deg, elevation_deg=0.0, intensity=2.0, distance_mm=math.inf):
    return direction(azimuth_deg, elevation_deg), intensity, distance_mm


def render(
    geometry,
    albedo,
    lights,
    *,
    sigma=0.0,
    specular=0.0,
    shadows=False,
    peak=0.9,
    noise=0.0,
    quantize=True,
    seed=0,
):
    """Return the linear texture; lights are (azimuth_deg, elevation_deg, intensity, distance_mm)."""
    position, normal, mask = geometry
    n_v = normal[..., 2]
    diffuse, gloss = np.zeros(mask.shape), np.zeros(mask.shape)
    for d, intensity, distance in starmap(_lamp, lights):
        distant = math.isinf(distance)
        vector = np.broadcast_to(d, position.shape) if distant else distance * d - position
        length = np.linalg.norm(vector, axis=-1)
        unit = vector / length[..., None]
        energy = intensity * np.ones(mask.shape) if distant else intensity * (distance / length) ** 2
        if shadows:
            energy = energy * march_shadow(position, d if distant else distance * d, distant)
        n_l = np.sum(normal * unit, -1)
        lit = n_l > 0
        theta_i, theta_r = np.arccos(np.clip(n_l, -1, 1)), np.arccos(np.clip(n_v, 0, 1))
        t_i = unit - n_l[..., None] * normal
        t_r = np.array([0, 0, 1.0]) - n_v[..., None] * normal
        across = np.linalg.norm(t_i, axis=-1) * np.linalg.norm(t_r, axis=-1)
        cos_phi = np.where(across > 1e-9, np.sum(t_i * t_r, -1) / np.maximum(across, 1e-9), 0)
        a = 1 - 0.5 * sigma**2 / (sigma**2 + 0.33)
        b = 0.45 * sigma**2 / (sigma**2 + 0.09)
        rough = a + b * np.maximum(cos_phi, 0) * np.sin(np.maximum(theta_i, theta_r)) * np.tan(
            np.minimum(np.minimum(theta_i, theta_r), 1.55)
        )
        diffuse += np.where(lit, energy * n_l * rough, 0)
        mirror = 2 * n_l[..., None] * normal - unit
        gloss += np.where(lit, energy * np.maximum(mirror[..., 2], 0) ** 20, 0)
    value = albedo.max(-1)
    lit_value = value * (1 + diffuse) + specular * gloss
    color = albedo * (lit_value / value)[..., None]
    color = color * (peak / np.max(color[mask]))
    if noise:
        color = color + noise * np.random.default_rng(seed).standard_normal(color.shape)
    color = np.clip(color, 0, 1)
    if quantize:
        color = quantize_srgb8(color)
    return (color * mask[..., None]).astype(np.float32)


def quantize_srgb8(linear):
    srgb = np.where(
        linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055
    )
    code = np.round(srgb * 255) / 255
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


GEOMETRIES = {"hemisphere": hemisphere_geometry, "bumps": bumps_geometry}


@cache
def lit_scene(shape, kind, *lights, size=64, seed=0, **settings):
    """Return a surface under lights (azimuth_deg, elevation_deg, 2.0, inf); bumps shade one another."""
    geometry = GEOMETRIES[shape](size)
    albedo = texture(kind, size, seed)
    color = render(geometry, albedo, lights, shadows=shape == "bumps", seed=seed, **settings)
    toward = np.array([lamp[0] for lamp in starmap(_lamp, lights)])
    return Scene(GeometryImage(*geometry, texture_linear=color), albedo, toward)


def lit_image(image, *, brdf="oren-nayar", prior=None, budget=Budget(), **options):
    """Return an image as a search holds it; `LitImage.posterior` makes its posteriors."""
    prior = AlbedoPrior.stationary() if prior is None else prior
    chosen, meter = EstimateOptions(**options), Meter("albedo", "", budget)
    return LitImage(image, usable_texels(image), brdf, (0.0, 0.0, 1.0), chosen, meter, prior)
