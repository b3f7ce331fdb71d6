"""Small scenes with known albedo, by the reference renderer, which shares nothing with the estimators."""

import math
from dataclasses import dataclass, replace
from functools import cache
from itertools import starmap

import numpy as np
from scipy.ndimage import gaussian_filter, uniform_filter

from scan2albedo.albedo import EstimateOptions, albedo_error
from scan2albedo.albedo.levels import usable_texels
from scan2albedo.albedo.prior import AlbedoPrior
from scan2albedo.albedo.shaded_image import ShadedImage
from scan2albedo.core import Budget, Meter
from scan2albedo.core.arrays import on_grid
from scan2albedo.core.geometry_image import GeometryImage
from scan2albedo.synthetic import Material, light_at, renderer


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


def farthest_deg(estimate, directions):
    """Return the largest angle from a true direction to the nearest light found."""
    return max(min(angle_deg(light, toward) for light in estimate.lights) for toward in directions)


def plan_row(estimate, name):
    """Return the row of the plan that tells of a part of the light."""
    (row,) = estimate.plan.of_stage(f"albedo.{name}")
    return row


def percent_off(estimate, scene):
    """Return the error of an estimated albedo, 100 times the mean square."""
    return albedo_error(estimate.albedo_linear, scene.albedo_linear, scene.image.mask).mse_percent


def hemisphere_geometry(size):
    """Equal-area disc chart of a hemisphere of 80 mm around +z."""
    axis = (np.arange(size) + 0.5) / size * 2 - 1
    u, v = np.meshgrid(axis, -axis)
    rho = np.hypot(u, v)
    mask = rho < 0.98
    ring = np.sqrt(np.maximum(2 - rho**2, 0))
    normal = np.stack([u * ring, v * ring, 1 - rho**2], -1) * mask[..., None]
    return 80.0 * normal, normal, mask


def bumps_geometry(size):
    """Height field with a ridge and hills that shade one another."""
    axis = ((np.arange(size) + 0.5) / size * 2 - 1) * 90.0
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
    return value[..., None] * np.array(tint)


def lamp(azimuth_deg, elevation_deg=0.0, intensity=2.0, distance_mm=math.inf):
    return light_at(azimuth_deg, elevation_deg, intensity=intensity, distance_mm=distance_mm)


def render(geometry, albedo, lights, *, material=Material(0.0), peak=0.9, noise=0.0, bits=8, seed=0, **seen):
    """Return the linear texture; lights are (azimuth_deg, elevation_deg, intensity, distance_mm)."""
    position, normal, mask = geometry
    surface = position[mask], normal[mask], albedo[mask]
    shown = renderer.render(*surface, list(starmap(lamp, lights)), material=material, **seen)
    light, rng = shown.radiance_linear, np.random.default_rng(seed)
    return on_grid(
        mask, renderer.photograph(light, exposure=peak / light.max(), noise=noise, bits=bits, rng=rng)
    )


def local_variance(image):
    """Return (H, W) the variance of the logarithm of an albedo's value around each texel."""
    value = np.log(np.maximum(image.max(-1).astype(float), 1e-4))
    return uniform_filter(value**2, 7) - uniform_filter(value, 7) ** 2


def lamps_and_waves(model, angles, intensities):
    """Return parameters of as many lamps as a model has, in waves of soft light where it has them."""
    toward = np.array([direction(*angle) for angle in angles[: model.lights]]).reshape(-1, 3)
    x = model.from_lights(toward, np.array(intensities)[: model.lights])
    if model.has("environment"):
        x[-8:] = np.random.default_rng(1).uniform(-0.15, 0.15, 8)
    return x


GEOMETRIES = {"hemisphere": hemisphere_geometry, "bumps": bumps_geometry}


@cache
def lit_scene(*lights, shape="hemisphere", kind="skin", size=64, seed=0, **settings):
    """Return a surface under lights (azimuth_deg, elevation_deg, 2.0, inf); bumps shade one another."""
    geometry = GEOMETRIES[shape](size)
    image = GeometryImage(*geometry)
    occluder = renderer.RayScene(*image.triangulated()) if shape == "bumps" else None
    albedo = texture(kind, size, seed)
    color = render(geometry, albedo, lights, occluder=occluder, seed=seed, **settings)
    toward = np.array([direction(*light[:2]) for light in lights])
    return Scene(replace(image, texture_linear=color), albedo, toward)


def shaded_image(image, *, brdf="oren-nayar", prior=None, budget=Budget(), **options):
    """Return an image as a search holds it; `ShadedImage.posterior` makes its posteriors."""
    prior = AlbedoPrior.stationary() if prior is None else prior
    chosen, meter = EstimateOptions(**options), Meter("albedo", "", budget)
    return ShadedImage(image, usable_texels(image), brdf, (0.0, 0.0, 1.0), chosen, meter, prior)
