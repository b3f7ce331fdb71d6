"""A deformed face model sampled over its own UV chart."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core.geometry_image import GeometryImage
from scan2albedo.face_model import AnnotatedFaceModel
from scan2albedo.geometry.mesh import normalized, vertex_normals
from scan2albedo.geometry.rasterization import interpolate, rasterize_uv
from scan2albedo.synthetic.textures import smooth_noise

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class FaceSurface:
    """The limit surface of a person.

    Parameters
    ----------
    vertices : (V, 3) float64
        Millimetres in the model's frame.
    faces : (F, 3) int64
    normals : (V, 3) float64
    corner_uv : (F, 3, 2) float64
        Chart coordinates of each face's corners.
    region : (F,) uint8
    landmarks : (68, 3) float64
    """

    vertices: FloatArray
    faces: IntArray
    normals: FloatArray
    corner_uv: FloatArray
    region: NDArray[np.uint8]
    landmarks: FloatArray


def face_surface(model: AnnotatedFaceModel, control_points: FloatArray, *, levels: int = 3) -> FaceSurface:
    """Return the refined limit surface of deformed control points (C, 3)."""
    subdivision = model.subdivision(levels)
    vertices = subdivision.matrix @ control_points
    corner_uv = _refined_corners(model.uv[model.control_faces], levels)
    landmarks = model.landmarks_of(control_points)
    return FaceSurface(
        vertices,
        subdivision.faces,
        vertex_normals(vertices, subdivision.faces),
        corner_uv,
        model.region[subdivision.parent],
        np.zeros((0, 3)) if landmarks is None else landmarks,
    )


def with_relief(
    surface: FaceSurface, rng: np.random.Generator, *, height_mm: float = 0.08, bumps: int = 40
) -> FaceSurface:
    """Return the surface with fine relief along its normals that no control mesh of the model can follow.

    Parameters
    ----------
    surface : FaceSurface
    rng : numpy.random.Generator
    height_mm : float
        Standard deviation of the relief.
    bumps : int
        About so many across the chart: 40 make wrinkles of 5 mm.
    """
    uv = np.zeros((len(surface.vertices), 2))
    uv[surface.faces.ravel()] = surface.corner_uv.reshape(-1, 2)
    height = height_mm * smooth_noise(uv, (bumps, bumps), rng)
    vertices = surface.vertices + height[:, None] * surface.normals
    return replace(surface, vertices=vertices, normals=vertex_normals(vertices, surface.faces))


def _refined_corners(corners: FloatArray, levels: int) -> FloatArray:
    """Return (F 4^levels, 3, K) corner values after linear refinement, children ordered as in Loop's."""
    for _ in range(levels):
        a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        children = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
        stacked = np.stack([np.stack(child, 1) for child in children], 1)
        corners = stacked.reshape(-1, 3, corners.shape[2])
    return corners


def face_geometry_image(model: AnnotatedFaceModel, surface: FaceSurface, size: int) -> GeometryImage:
    """Return the (size, size) geometry image of a surface, annotated, without texture."""
    corner_index = np.arange(3 * len(surface.faces)).reshape(-1, 3)
    raster = rasterize_uv(surface.corner_uv.reshape(-1, 2), corner_index, size)
    mask = raster.covered
    region = np.full(mask.shape, 255, np.uint8)
    region[mask] = surface.region[raster.face[mask]]
    return GeometryImage(
        interpolate(raster, surface.faces, surface.vertices),
        normalized(interpolate(raster, surface.faces, surface.normals)),
        mask,
        region=region,
        occluder=(surface.vertices, surface.faces),
        specular_scale=np.where(mask, model.region_values("specular_scale")[region], 0),
        inpaint=mask & (model.region_values("inpaint")[region] > 0),
    )
