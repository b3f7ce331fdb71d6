"""Shapes of random people: identity and expression as bumps on the model, sampled over its chart."""

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from scan2albedo.core import GeometryImage
from scan2albedo.core.arrays import ByteArray, FloatArray, IntArray, on_grid
from scan2albedo.errors import ModelError
from scan2albedo.face_model import AnnotatedSurface, variation
from scan2albedo.geometry.mesh import normalized, vertex_normals
from scan2albedo.geometry.rasterization import interpolate, rasterize_uv
from scan2albedo.geometry.rigid import procrustes, transform_points
from scan2albedo.synthetic.textures import smooth_noise

Expression = Literal["neutral", "smile", "frown", "pout", "puff", "surprise"]


def person(
    model: AnnotatedSurface,
    rng: np.random.Generator,
    *,
    expression: Expression = "neutral",
    strength: float = 1.0,
    expression_strength: float = 1.0,
) -> FloatArray:
    """Return control points (C, 3) in mm of a random person, rigidly aligned to the model at rest.

    `strength` scales the identity (0 keeps the model's own) and `expression_strength` the expression; lips
    stay closed. ModelError when the model has no landmarks, which place the bumps.
    """
    if expression not in get_args(Expression):
        raise ValueError(f"expression is {expression!r}, expected one of {get_args(Expression)}")
    rest, landmarks = model.control_vertices, model.landmarks
    if landmarks is None:
        raise ModelError(f"{model.name}: identity modes are placed by landmarks, but it has none")
    stretch = 1 + strength * np.clip(rng.normal(size=3), -2, 2) * variation.STRETCH_SD
    offset = np.zeros_like(rest)
    for bump in variation.IDENTITY_BUMPS + variation.ASYMMETRY_BUMPS:
        offset += strength * np.clip(rng.normal(), -2, 2) * variation.displacement(bump, rest, landmarks)
    for bump in variation.EXPRESSION_BUMPS[expression]:
        offset += expression_strength * rng.uniform(0.8, 1.2) * variation.displacement(bump, rest, landmarks)
    shaped = (rest + offset) * stretch
    return transform_points(procrustes(shaped, rest), shaped)


def expression_offsets(model: AnnotatedSurface, rng: np.random.Generator, *, levels: int) -> FloatArray:
    """Return (E, V, 3) random expressions, eight of a kind, less the face at rest; mm on the surface."""
    to_surface = model.subdivision(levels).matrix
    moved = [
        person(model, rng, strength=0.0, expression=name) - model.control_vertices
        for name in get_args(Expression)[1:]
        for _ in range(8)
    ]
    return np.stack([to_surface @ offset for offset in moved])


@dataclass(frozen=True)
class FaceSurface:
    """The limit surface of a person, mm in the model's frame.

    `vertices` and `normals` (V, 3), `faces` (F, 3), chart coordinates `uv` (V, 2), `region` (F,), `landmarks`
    (68, 3).
    """

    vertices: FloatArray
    faces: IntArray
    normals: FloatArray
    uv: FloatArray
    region: ByteArray
    landmarks: FloatArray


def face_surface(model: AnnotatedSurface, control_points: FloatArray, *, levels: int = 3) -> FaceSurface:
    """Return the refined limit surface of deformed control points (C, 3)."""
    subdivision = model.subdivision(levels)
    vertices = subdivision.matrix @ control_points
    landmarks = model.landmarks_of(control_points)
    marks = np.zeros((0, 3)) if landmarks is None else landmarks
    faces, region = subdivision.faces, model.region[subdivision.parent]
    return FaceSurface(
        vertices, faces, vertex_normals(vertices, faces), model.refined_uv(levels), region, marks
    )


def with_relief(surface: FaceSurface, rng: np.random.Generator, *, height_mm: float = 0.08) -> FaceSurface:
    """Return the surface with fine relief along its normals that no control mesh of the model can follow.

    Its standard deviation is `height_mm`; wrinkles are 5 mm wide, 40 across the chart.
    """
    height = height_mm * smooth_noise(surface.uv, (40, 40), rng)
    vertices = surface.vertices + height[:, None] * surface.normals
    return replace(surface, vertices=vertices, normals=vertex_normals(vertices, surface.faces))


def face_geometry_image(model: AnnotatedSurface, surface: FaceSurface, size: int) -> GeometryImage:
    """Return the (size, size) geometry image of a surface, annotated, without texture."""
    raster = rasterize_uv(surface.uv, surface.faces, size)
    mask = raster.covered
    region = on_grid(mask, surface.region[raster.face[mask]], 255)
    return GeometryImage(
        interpolate(raster, surface.faces, surface.vertices),
        normalized(interpolate(raster, surface.faces, surface.normals)),
        mask,
        region=region,
        occluder=(surface.vertices, surface.faces),
        specular_scale=np.where(mask, model.region_values("specular_scale")[region], 0),
        inpaint=mask & (model.region_values("inpaint")[region] > 0),
    )
