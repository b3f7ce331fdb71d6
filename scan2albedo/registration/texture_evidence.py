"""What a scan's colours say of a pose: whether brows, eyes and lips lie where the model has them there."""

from __future__ import annotations

import numpy as np

from scan2albedo.core.arrays import FloatArray
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.face_model import AnnotatedSurface
from scan2albedo.face_model.appearance import appearance
from scan2albedo.geometry.closest_points import NearestSurface
from scan2albedo.geometry.front_picture import scan_colors
from scan2albedo.geometry.mesh import normalized, vertex_normals
from scan2albedo.geometry.operators import linear_refinement
from scan2albedo.geometry.rasterization import interpolate, rasterize_uv
from scan2albedo.geometry.rigid import invert_rigid, transform_points

_SIZE, _LEVELS = 64, 1
"""Texels a side of the chart, some 3 mm each, and refinements of the model there."""
_MOST_FACES = 50_000
"""Of more faces of a scan every so-manieth is looked at: they are far smaller than a feature then."""
_NEAR_MM, _LEAST_SEEN = 8.0, 0.25
"""How near the scan must be, and of how much of the model."""


class ColourScorer:
    """A coloured scan, prepared to say of many poses how a face's colours speak for them.

    `of` returns None where there is nothing to say: a scan without colours, a model that is not annotated.
    """

    def __init__(self, scan: RawScan, model: AnnotatedSurface, face_uv: FloatArray) -> None:
        self._scan = scan
        self._stride = len(scan.faces) // _MOST_FACES + 1
        self._surface = NearestSurface(scan.vertices, scan.faces[:: self._stride])
        points, faces = model.surface(_LEVELS)
        refined = linear_refinement(len(face_uv), model.control_faces, _LEVELS) @ face_uv
        raster = rasterize_uv(model.refined_uv(_LEVELS), faces, _SIZE)
        self._covered, self._front = raster.covered, model.front
        self._points = interpolate(raster, faces, points)
        self._normals = normalized(interpolate(raster, faces, vertex_normals(points, faces)))
        self._place = interpolate(raster, faces, np.column_stack([1 - refined[:, 1], refined[:, 0]]))

    @classmethod
    def of(cls, scan: RawScan, model: AnnotatedSurface) -> ColourScorer | None:
        """Prepare a scan (mm)."""
        if not scan.has_color or model.face_uv is None:
            return None
        return cls(scan, model, model.face_uv)

    def log_odds(self, model_from_scan: FloatArray, face_scale: float = 1.0) -> float:
        """Return the log odds of a right pose against a wrong one by the colours, 0 where they say nothing.

        `model_from_scan` (4, 4) is rigid, and `face_scale` the face's size relative to the model's, which
        keeps the place of its front.
        """
        sized = self._front + face_scale * (self._points[self._covered] - self._front)
        hits = self._surface.query(transform_points(invert_rigid(model_from_scan), sized))
        color, shown = scan_colors(self._scan, hits.face * self._stride, hits.barycentric)
        near = shown & (hits.distance < _NEAR_MM) & (color.max(1) > 0)
        if near.mean() < _LEAST_SEEN:
            return 0.0
        texture, seen = np.zeros((*self._covered.shape, 3), np.float32), self._covered.copy()
        texture[self._covered], seen[self._covered] = color, near
        looks = appearance(face_scale * self._points, self._normals, seen, texture, place=self._place)
        # Noise, paint or another's picture look like a wrong pose: they alone must not refuse a face.
        return float(np.clip(looks.log_odds, -2, 3))
