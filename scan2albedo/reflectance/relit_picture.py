"""A picture of a face under a flash, from the reflectance of its vertices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.geometry.mesh import face_cross_products
from scan2albedo.geometry.operators import filled_over_mesh
from scan2albedo.geometry.pinhole import camera_centers, project
from scan2albedo.geometry.rasterization import Raster, interpolate, rasterize
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.lighting.shadow_map import shadow_origins
from scan2albedo.reflectance.point_light_lobes import point_light_lobes
from scan2albedo.reflectance.vertex_reflectance import VertexReflectance
from scan2albedo.reflectance.vertex_visibility import RAY_OFFSET_MM

_SIDE = 3
"""Rays along each side of a pixel, to the face and on to the flash."""


@dataclass(frozen=True)
class RelitFace:
    """A mesh whose vertices reflect; pictures of it are shaded and shadowed pixel by pixel.

    Vertices that are not known are filled from those around them.
    """

    vertices: FloatArray
    """(V, 3), mm."""
    faces: IntArray
    normals: FloatArray
    """(V, 3): unit; 0 where there is none."""
    reflectance: VertexReflectance

    def picture(
        self,
        camera: FloatArray,
        shape: tuple[int, int],
        light: FloatArray,
        *,
        reference_distance_mm: float | None = None,
    ) -> tuple[FloatArray, BoolArray]:
        """Return radiance (H, W, 3) under a light of strength 1 at (3,), and where all of it is known (H, W).

        Each pixel of `camera` (3, 4) is the mean of nine rays. What lies between a triangle and the light is
        found from the curved surface through its corners' normals (Hanika, "Hacking the Shadow Terminator",
        2021), so that no facet shadows itself.
        """
        raster, kept = self._raster(camera, (shape[0] * _SIDE, shape[1] * _SIDE))
        inside = raster.covered
        made = np.zeros((*inside.shape, 3))
        certain = np.zeros(inside.shape)
        if inside.any() and self.reflectance.known.any():
            corners, weight = kept[raster.face[inside]], raster.barycentric[inside]
            made[inside] = self._radiance(corners, weight, camera, light, reference_distance_mm)
            certain = interpolate(raster, kept, self.reflectance.known.astype(np.float64))
        cells = (shape[0], _SIDE, shape[1], _SIDE)
        known = np.asarray((certain > 1 - 1e-9).reshape(cells).all((1, 3)))
        return made.reshape(*cells, 3).mean((1, 3)), known

    def _raster(self, camera: FloatArray, shape: tuple[int, int]) -> tuple[Raster, IntArray]:
        """Return what fine pixels see, and the triangles (K, 3) it counts: those that face the camera."""
        pixels, depth = project(camera, self.vertices)
        ahead = np.asarray(np.isfinite(pixels).all(1))
        across = face_cross_products(self.vertices, self.faces)
        toward = camera_centers(camera[None])[0] - self.vertices[self.faces[:, 0]]
        kept = self.faces[ahead[self.faces].all(1) & (np.einsum("fc,fc->f", across, toward) > 0)]
        fine = _SIDE * np.where(ahead[:, None], pixels, 0.0) + (_SIDE - 1) / 2
        return rasterize(fine, -depth, kept, shape), kept

    def _radiance(
        self,
        corners: IntArray,
        weight: FloatArray,
        camera: FloatArray,
        light: FloatArray,
        reference_distance_mm: float | None,
    ) -> FloatArray:
        """Return (N, 3) of points in triangles of vertices `corners` (N, 3)."""
        one = self.reflectance
        numbers = filled_over_mesh(
            np.concatenate([one.diffuse_linear, one.weights], axis=1), one.known, self.faces
        )
        albedo, gloss = np.split(np.einsum("nk,nkc->nc", weight, numbers[corners]), [3], axis=1)
        point = np.einsum("nk,nkc->nc", weight, self.vertices[corners])
        normal = np.einsum("nk,nkc->nc", weight, self.normals[corners])
        normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-12)[:, None]
        center = camera_centers(camera[None])
        lobes = point_light_lobes(
            point, normal, center, light[None], reference_distance_mm=reference_distance_mm
        )[0]
        made = lobes[:, :1] * albedo + (lobes[:, 1:] * gloss).sum(1)[:, None]
        lit = np.flatnonzero(lobes[:, 0] > 0)
        made[lit[self._hidden(point[lit], corners[lit], weight[lit], normal[lit], light)]] = 0.0
        return made

    def _hidden(
        self, point: FloatArray, corners: IntArray, weight: FloatArray, normal: FloatArray, light: FloatArray
    ) -> BoolArray:
        """Return (N,) whether the mesh stands between points and the light."""
        middle = (self.vertices.min(0) + self.vertices.max(0)) / 2
        caster = RayCaster(self.vertices - middle, self.faces)
        way = point[:, None] - self.vertices[corners]
        below = np.minimum(np.einsum("nkc,nkc->nk", way, self.normals[corners]), 0.0)
        raised = point - np.einsum("nk,nk,nkc->nc", weight, below, self.normals[corners])
        start = shadow_origins(caster, raised - middle, normal, RAY_OFFSET_MM)
        return caster.occluded_local(start, light - raised)
