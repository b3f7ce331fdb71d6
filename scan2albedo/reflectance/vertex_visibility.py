"""Which vertices each camera sees, and each flash lights, away from edges."""

from __future__ import annotations

import math

import numpy as np

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.geometry.mesh import edges_with_faces
from scan2albedo.geometry.pinhole import camera_centers, pixel_directions, project
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.lighting.shadow_map import ShadowMap

_SIDES = np.array([[1.0, 0], [-1, 0], [0, 1], [0, -1]])
RAY_OFFSET_MM = 0.2
"""Rays start this far along the normal, see `lighting.shadow_map.ShadowMap`."""
_DEPTH_STEP_MM = 3.0
"""A step in depth above this, and above what the slope explains, is an edge."""
_SHADOW_RINGS = 1
"""Edges of the mesh between a lit vertex and the nearest one in cast shadow."""
_MOST_SLOPE = 5.0
"""Of the surface's depth against the picture plane: a steeper step is an edge."""


class VertexVisibility:
    """Rays between the V vertices of a face (mm) and its cameras and flashes; answers are kept."""

    def __init__(self, vertices: FloatArray, faces: IntArray, normals: FloatArray) -> None:
        self._vertices, self._normals = vertices, normals
        # A shadow map takes lights by direction and distance from the origin, which must therefore be near.
        self._center = (vertices.min(0) + vertices.max(0)) / 2
        local = vertices - self._center
        self._caster = RayCaster(local, faces)
        self._map = ShadowMap(self._caster, local, normals, RAY_OFFSET_MM)
        self._edges, _ = edges_with_faces(faces)
        self._seen: dict[bytes, BoolArray] = {}

    def reached(self, position: FloatArray) -> BoolArray:
        """Return (V,) whether nothing stands between a vertex that faces `position` (3,) and it."""
        key = position.tobytes()
        if key not in self._seen:
            toward = position - self._center
            distance = float(np.linalg.norm(toward))
            self._seen[key] = self._map.visible(toward / (distance or 1.0), distance or 1e-9) > 0
        return self._seen[key]

    def lit(self, light: FloatArray) -> BoolArray:
        """Return (V,) vertices that the light at (3,) reaches, away from cast shadows."""
        reached = self.reached(light)
        facing = np.einsum("vc,vc->v", self._normals, light - self._vertices) > 0
        hidden = facing & ~reached
        for _ in range(_SHADOW_RINGS):
            wider = hidden.copy()
            wider[self._edges[hidden[self._edges[:, 1]], 0]] = True
            wider[self._edges[hidden[self._edges[:, 0]], 1]] = True
            hidden = wider
        return reached & ~hidden

    def seen(self, camera: FloatArray, cosine: float, margin_px: float) -> BoolArray:
        """Return (V,) vertices that a camera (3, 4) sees, normals at least `cosine` to the line of sight.

        The surface must continue `margin_px` to all four sides, without a hole or a depth step beyond its
        slope.
        """
        position = camera_centers(camera[None])[0]
        sight = position - self._vertices
        distance = np.linalg.norm(sight, axis=1)
        n_v = np.einsum("vc,vc->v", self._normals, sight) / np.maximum(distance, 1e-12)
        result = self.reached(position) & (n_v > cosine)
        if margin_px > 0 and result.any():
            rows = np.flatnonzero(result)
            result[rows] = self._inside(camera, position, rows, n_v[rows], margin_px)
        return result

    def _inside(
        self,
        camera: FloatArray,
        position: FloatArray,
        rows: IntArray,
        n_v: FloatArray,
        margin_px: float,
    ) -> BoolArray:
        pixels, depth = project(camera, self._vertices[rows])
        good = np.asarray(np.isfinite(pixels).all(1))
        pixels = np.where(good[:, None], pixels, 0.0)
        forward = camera[2, :3]
        pixel_mm = depth / math.sqrt(abs(float(np.linalg.det(camera[:, :3]))))
        slope = np.minimum(np.sqrt(np.maximum(1 - n_v**2, 0)) / n_v, _MOST_SLOPE)
        allowed = _DEPTH_STEP_MM + 2 * margin_px * pixel_mm * slope
        for side in _SIDES:
            along = pixel_directions(camera, pixels + margin_px * side)
            hits = self._caster.first_hit(np.broadcast_to(position - self._center, along.shape), along)
            missed = hits.face < 0
            other = np.where(missed, 0.0, hits.distance) * (along @ forward)
            good &= ~missed & (np.abs(other - depth) <= allowed)
        return good
