"""Synthetic scenes: a geometry image, its true albedo, and everything that lit it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from scan2albedo.core import GeometryImage, PointLight
from scan2albedo.core.arrays import BoolArray, Float32Array, FloatArray, dots, norms, on_grid
from scan2albedo.face_model import AnnotatedSurface, default_model
from scan2albedo.geometry.mesh import normalized
from scan2albedo.synthetic.face_shape import Expression, face_geometry_image, face_surface, person
from scan2albedo.synthetic.renderer import Material, RayScene, auto_exposure, photograph, render
from scan2albedo.synthetic.textures import paint_face, painter, smooth_noise

TextureName = Literal["plain", "skin", "wood"]


@dataclass(frozen=True)
class SyntheticScene:
    """A geometry image with its ground truth.

    ``image.texture_linear = camera(gain (albedo shading + specular))``.
    """

    image: GeometryImage
    """With texture, ready for `estimate_albedo`."""
    albedo_linear: Float32Array
    """(H, W, 3): the truth; zeros outside the mask."""
    lights: tuple[PointLight, ...]
    """Relative to ambient = 1."""
    shadow: BoolArray
    """(H, W, L): True where light l does not reach the texel (turned away or hidden); False outside the
    mask."""
    shading: FloatArray
    """(H, W): ``1 + sum of lights``, before the gain; zeros outside the mask."""
    specular: FloatArray
    """(H, W): highlights before the gain."""
    gain: float
    """Factor from radiance (albedo under ambient light 1) to the picture, where 1 is white."""
    material: Material
    texture: str
    """`material`, `texture`: what it was made with."""


def light_at(
    azimuth_deg: float, elevation_deg: float = 0.0, *, distance_mm: float = np.inf, intensity: float = 3.0
) -> PointLight:
    """Return a light given in degrees.

    Parameters
    ----------
    azimuth_deg, elevation_deg, distance_mm, intensity : float
        As in `PointLight`.
    """
    return PointLight(math.radians(azimuth_deg), math.radians(elevation_deg), distance_mm, intensity)


def hemisphere(
    *,
    lights: Sequence[PointLight] | None = None,
    texture: TextureName = "wood",
    size: int = 512,
    material: Material | None = None,
    grain: float = 1.0,
    noise: float = 0.0,
    bits: int | None = 8,
    exposure: float = 1.0,
    seed: int = 0,
) -> SyntheticScene:
    """Return a hemisphere of 80 mm radius about the origin, bulging toward +z.

    The chart is Lambert's azimuthal equal-area map: a disc that fills the square, +u toward +x.

    Parameters
    ----------
    lights : sequence of PointLight, optional
        One distant light at 45 degrees when omitted.
    texture : "plain", "skin" or "wood"
    size : int
        Height and width in texels.
    material : Material, optional
        Oren-Nayar with sigma 0.3 rad and no highlight when omitted.
    grain : float
        Size of the texture's pattern.
    noise : float
        Standard deviation of Gaussian noise on the linear picture (white = 1).
    bits : int or None
        Quantisation of the sRGB-encoded picture; None for none.
    exposure : float
        1 keeps the brightest texel just below white; larger values clip.
    seed : int
        Of texture and noise.
    """
    uv = texel_coordinates(size)
    disc = 2 * uv - 1
    radius = norms(disc)
    inside = radius < 1
    # Equal area: rho = 2 R sin(theta / 2), scaled so that theta = 90 degrees lies on the rim.
    z = 1 - radius**2
    normal = np.column_stack([disc * np.sqrt(np.maximum(0, 2 - radius**2))[:, None], z])
    normal[~inside] = 0
    normal = normal.reshape(size, size, 3)
    image = GeometryImage(80 * normal, normal, inside.reshape(size, size))
    albedo = painter(texture)(uv[inside], np.random.default_rng(seed), grain=grain)
    return _photographed(image, albedo, lights, material, texture, exposure, noise, bits, seed)


def face(
    seed: int = 0,
    *,
    expression: Expression = "neutral",
    lights: Sequence[PointLight] | None = None,
    texture: TextureName = "skin",
    size: int = 512,
    material: Material | None = None,
    grain: float = 1.0,
    noise: float = 0.0,
    bits: int | None = 8,
    exposure: float = 1.0,
    model: AnnotatedSurface | None = None,
) -> SyntheticScene:
    """Return a random person's face on the model's chart, with cast shadows.

    Parameters
    ----------
    seed : int
        Of identity, texture and noise.
    expression : str
        One of neutral, smile, frown, pout, puff, surprise.
    lights : sequence of PointLight, optional
        One distant light at 45 degrees when omitted.
    texture : "plain", "skin" or "wood"
        "skin" comes with brows, lips and eyes.
    size, material, grain, noise, bits, exposure
        As in `hemisphere`; the model's annotation scales the highlights.
    model : AnnotatedFaceModel, optional
        The default model when omitted; it needs landmarks.
    """
    template = model or default_model()
    control_points = person(template, np.random.default_rng([seed, 2]), expression=expression)
    image = face_geometry_image(template, face_surface(template, control_points), size)
    uv = texel_coordinates(size)[image.mask.ravel()]
    rng = np.random.default_rng(seed)
    if texture == "skin":
        albedo = paint_face(uv, template, rng, grain=grain)
    else:
        albedo = painter(texture)(uv, rng, grain=grain)
    return _photographed(image, albedo, lights, material, texture, exposure, noise, bits, seed)


def with_normal_error(image: GeometryImage, rms_deg: float, rng: np.random.Generator) -> GeometryImage:
    """Return the image with its normals tilted by a smooth random field, as an imperfect fit leaves them.

    Parameters
    ----------
    image : GeometryImage
    rms_deg : float
        Of the tilt over the surface; its bumps are about 1/24 of the chart.
    rng : numpy.random.Generator
    """
    mask, normal = image.mask, image.normal[image.mask]
    uv = texel_coordinates(max(image.shape))[mask.ravel()]
    push = np.stack([smooth_noise(uv, (24, 24), rng) for _ in range(3)], 1)
    push -= dots(push, normal)[:, None] * normal
    push *= np.deg2rad(rms_deg) / np.sqrt(np.mean(np.sum(push**2, axis=1)))
    tilted = image.normal.copy()
    tilted[mask] = normalized(normal + push)
    return replace(image, normal=tilted)


def texel_coordinates(size: int) -> FloatArray:
    """Return (size^2, 2) texture coordinates of texel centres in row-major order, row 0 at v = 1."""
    centers = (np.arange(size) + 0.5) / size
    u, v = np.meshgrid(centers, 1 - centers)
    return np.stack([u.ravel(), v.ravel()], 1)


def _photographed(
    image: GeometryImage,
    albedo_linear: FloatArray,
    lights: Sequence[PointLight] | None,
    material: Material | None,
    texture: str,
    exposure: float,
    noise: float,
    bits: int | None,
    seed: int,
) -> SyntheticScene:
    """Photograph a surface whose N texels have an albedo (N, 3)."""
    lights = (light_at(45),) if lights is None else tuple(lights)
    material = material or Material()
    mask = image.mask
    scale = np.ones(int(mask.sum())) if image.specular_scale is None else image.specular_scale[mask]
    surface = image.position[mask], image.normal[mask], albedo_linear
    occluder = RayScene(*image.occluder_mesh())
    rendered = render(*surface, lights, material=material, occluder=occluder, specular_scale=scale)
    gain = exposure * auto_exposure(rendered.radiance_linear)
    rng = np.random.default_rng([seed, 1])
    picture = photograph(rendered.radiance_linear, exposure=gain, noise=noise, bits=bits, rng=rng)
    observed = replace(image, texture_linear=on_grid(mask, picture))
    albedo = on_grid(mask, albedo_linear.astype(np.float32))
    light = (
        on_grid(mask, ~rendered.visible),
        on_grid(mask, rendered.shading),
        on_grid(mask, rendered.specular),
    )
    return SyntheticScene(observed, albedo, lights, *light, gain, material, texture)
