"""A picture of a face under a flash, from the reflectance of its vertices."""

from __future__ import annotations

import numpy as np

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.geometry.mesh import face_cross_products, normalized
from scan2albedo.geometry.operators import filled_over_mesh
from scan2albedo.geometry.pinhole import camera_centers
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.lighting.shadow_map import ShadowMap
from scan2albedo.reflectance.point_light_lobes import point_light_lobes
from scan2albedo.reflectance.vertex_reflectance import VertexReflectance
from scan2albedo.reflectance.vertex_visibility import RAY_OFFSET_MM
from scan2albedo.rendering.pictures import seen_samples

_SIDE = 3
"""Rays along each side of a pixel, to the face and on to the flash."""


def relit_picture(
    vertices: FloatArray,
    faces: IntArray,
    normals: FloatArray,
    reflectance: VertexReflectance,
    *,
    camera: FloatArray,
    shape: tuple[int, int],
    light: FloatArray,
    reference_distance_mm: float | None = None,
) -> tuple[FloatArray, BoolArray]:
    """Return radiance (H, W, 3) under a light of strength 1 at (3,), and where all of it is known (H, W).

    The mesh's vertices (V, 3), mm, have unit `normals`, 0 where there is none; those whose reflectance is not
    known are filled from those around them. Each pixel of `camera` (3, 4) is the mean of nine rays, shaded
    and shadowed one by one. The back of the mesh is not seen.
    """
    center = camera_centers(camera[None])
    across = face_cross_products(vertices, faces)
    front = np.einsum("fc,fc->f", across, center - vertices[faces[:, 0]]) > 0
    seen = seen_samples(vertices, faces[front], camera, shape, _SIDE)
    if len(seen.index) == 0 or not reflectance.known.any():
        return np.zeros((*shape, 3)), np.zeros(shape, bool)
    numbers = np.concatenate([reflectance.diffuse_linear, reflectance.weights], axis=1)
    albedo, gloss = np.split(
        seen.interpolated(filled_over_mesh(numbers, reflectance.known, faces)), [3], axis=1
    )
    point, normal = seen.interpolated(vertices), normalized(seen.interpolated(normals))
    lobes = point_light_lobes(
        point, normal, center, light[None], reference_distance_mm=reference_distance_mm
    )[0]
    # Lamps have their place around the origin, which is to lie inside the mesh.
    middle = (vertices.min(0) + vertices.max(0)) / 2
    curved, distance = seen.raised(vertices, normals, outward=True), float(np.linalg.norm(light - middle))
    shadows = ShadowMap(RayCaster(vertices - middle, faces), curved - middle, normal, RAY_OFFSET_MM)
    lit = (lobes[:, 0] > 0) & (shadows.visible((light - middle) / distance, distance) > 0)
    radiance = lobes[:, :1] * albedo + (lobes[:, 1:] * gloss).sum(1)[:, None]
    certain = seen.interpolated(reflectance.known.astype(np.float64)) > 1 - 1e-9
    made = seen.picture(np.column_stack([radiance * lit[:, None], certain]))
    return made[..., :3], made[..., 3] == 1
