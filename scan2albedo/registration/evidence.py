"""What speaks for a face at a pose: its shape, once the template has it, and the places of its features."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from scan2albedo.core import Meter
from scan2albedo.core.arrays import FloatArray
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.face_model import AnnotatedSurface
from scan2albedo.face_model.appearance import appearance
from scan2albedo.geometry.closest_points import NearestSurface
from scan2albedo.geometry.mesh import normalized, vertex_normals
from scan2albedo.geometry.operators import linear_refinement
from scan2albedo.geometry.rasterization import interpolate, rasterize_uv, scan_colors
from scan2albedo.geometry.rigid import Similarity, invert_rigid, transform_points
from scan2albedo.registration.icp import residuals, shaped_icp
from scan2albedo.registration.inputs import PreparedScan, Template
from scan2albedo.registration.relief import ReliefAgreement

_MOST_RMS_MM, _LEAST = 10.0, 0.02
"""Bounds of what is weighed: distances, and 1 - r^2 and the share before their logarithm."""
_NOISE_IN_DISTANCE = 0.3
"""Part of the noise's variance that the squared distance holds: it is to samples averaged over 4 mm."""
_INTERCEPT, _WEIGHTS = 4.51, {"relief": 5.56, "distance": -1.11, "share": 3.91}
"""Of the cues in the log odds: a logistic regression, by tools/calibrate_registration.py. Seeds from 300:
of people four kinds with 20 to 30 scans each, 48 scraps, 10 each of what else is no face."""


@dataclass(frozen=True)
class Evidence:
    """Agreement of the scan with the shaped template at its pose.

    `pose` is `scan_from_model`, `coefficients` (K,) are those of the template's modes in standard deviations.
    `share` is the part of the template's area with scan within 10 mm that faces the same way, `rms_mm` the
    distance there; `relief` compares their depth images.
    """

    pose: Similarity
    coefficients: FloatArray
    share: float
    rms_mm: float
    relief: ReliefAgreement

    @property
    def cues(self) -> dict[str, float]:
        """The values that are weighed, each finite, as they would be about without the scan's noise.

        Relief that correlates by r says -log(1 - r^2), its mutual information, for as much face as shows it.
        """
        unlike = 1 - max(self.relief.without_noise(), 0.0) ** 2
        noise = _NOISE_IN_DISTANCE * self.relief.noise_mm**2
        return {
            "relief": -self.relief.coverage * float(np.log(max(unlike, _LEAST))),
            "distance": max(min(self.rms_mm, _MOST_RMS_MM) ** 2 - noise, 0.0),
            "share": float(np.log(max(self.share, _LEAST))),
        }

    @property
    def log_odds(self) -> float:
        """Logarithm of the odds that the pose is that of a face, by its shape alone."""
        return _INTERCEPT + sum(_WEIGHTS[name] * value for name, value in self.cues.items())


def evidence(scan: PreparedScan, template: Template, start: Similarity, meter: Meter) -> Evidence:
    """Fit pose and shape of the template from a start, and measure how the scan agrees with it."""
    shaped = shaped_icp(scan.samples, template, start, meter)
    samples = template.in_shape(shaped.coefficients).samples
    measured = residuals(scan.samples, samples, shaped.pose)
    moved = np.tensordot(shaped.coefficients, template.control_modes, 1)
    surface = template.image.vertices + template.surface_from_control @ moved
    return Evidence(
        shaped.pose,
        shaped.coefficients,
        float(samples.areas[measured.inlier].sum() / samples.areas.sum()),
        measured.trimmed_rms_mm(samples.areas),
        template.image.agreement(scan.vertices, scan.faces, shaped.pose.inverse(), surface, scan.noise),
    )


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
    def of(cls, scan: RawScan, model: AnnotatedSurface) -> Self | None:
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
