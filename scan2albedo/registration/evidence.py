"""What speaks for a face at a pose: its shape, once the template has it, and the places of its features."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from scan2albedo.core import Meter, RawScan
from scan2albedo.core.arrays import FloatArray
from scan2albedo.face_model import AnnotatedSurface
from scan2albedo.face_model.materials import chart_materials
from scan2albedo.geometry.alignment import Alignment
from scan2albedo.geometry.closest_points import NearestSurface
from scan2albedo.geometry.mesh import normalized, vertex_normals
from scan2albedo.geometry.operators import linear_refinement
from scan2albedo.geometry.rasterization import interpolate, rasterize_uv, scan_colors
from scan2albedo.geometry.rigid import Similarity, invert_rigid, transform_points
from scan2albedo.registration.icp import FEW, coarsely_shaped, residuals, shaped_icp
from scan2albedo.registration.inputs import PreparedScan, Template
from scan2albedo.registration.relief import ReliefAgreement

_MOST_RMS_MM = 10.0
"""Greatest distance that is weighed."""
_LEAST = 0.02
"""Least value of 1 - r^2, and of the share, before their logarithm."""
_NOISE_IN_DISTANCE = 0.3
"""Part of the noise's variance that the squared distance holds: it is to samples averaged over 4 mm."""
_INTERCEPT = 4.51
"""Log odds of a face where all cues are 0: a logistic regression, by tools/calibrate_registration.py of
commit 1592766c. Seeds from 300: of people four kinds with 20 to 30 scans each, 48 scraps, 10 each of what
else is no face."""
_WEIGHTS = {"relief": 5.56, "distance": -1.11, "share": 3.91}
"""Of the cues in the log odds, by the same regression."""
HOPELESS = -6.0
"""Log odds below which a pose is left: of 77 that few samples found below it all ended below -4.4, of 23 just
above it one at 6; colours add 3 at most."""


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
    """Fit pose and shape of the template from a start, and measure how the scan agrees with it.

    What few samples find hopeless is not refined with all.
    """
    shaped = coarsely_shaped(scan.samples, template, start, meter)
    found = _measured(scan, template.first(FEW), shaped)
    if found.log_odds < HOPELESS:
        return found
    return _measured(scan, template, shaped_icp(scan.samples, template, shaped, meter))


def _measured(scan: PreparedScan, template: Template, shaped: Alignment) -> Evidence:
    person = template.in_shape(shaped.coefficients)
    samples = person.samples
    measured = residuals(scan.samples, samples, shaped.pose)
    return Evidence(
        shaped.pose,
        shaped.coefficients,
        float(samples.areas[measured.inlier].sum() / samples.areas.sum()),
        measured.trimmed_rms_mm(samples.areas),
        template.image.agreement(
            scan.vertices, scan.faces, shaped.pose.inverse(), person.surface, scan.noise
        ),
    )


_SIZE = 64
"""Texels a side of the chart: some 3 mm each."""
_LEVELS = 1
"""Refinements of the model on the chart."""
_MOST_FACES = 50_000
"""Of more faces of a scan every so-manieth is looked at: they are far smaller than a feature then."""
_NEAR_MM = 8.0
"""How near the scan must be to the model."""
_LEAST_SEEN = 0.25
"""Part of the model that must have scan so near."""


ColourScorer = Callable[[FloatArray, float], float]
"""Gives the log odds of a right pose against a wrong one; see `colour_scorer`."""


def colour_scorer(scan: RawScan, model: AnnotatedSurface) -> ColourScorer | None:
    """Return what says of many poses how a face's colours speak for them, of a scan in mm.

    A pose is a rigid `model_from_scan` (4, 4), and the face's size relative to the model's, which keeps the
    place of its front. The log odds are 0 where the colours say nothing. None for a scan without colours, or
    a model that is not annotated.
    """
    if not scan.has_color or model.face_uv is None:
        return None
    stride = len(scan.faces) // _MOST_FACES + 1
    surface = NearestSurface(scan.vertices, scan.faces[::stride])
    vertices, faces = model.surface(_LEVELS)
    refined = linear_refinement(len(model.face_uv), model.control_faces, _LEVELS) @ model.face_uv
    raster = rasterize_uv(model.refined_uv(_LEVELS), faces, _SIZE)
    covered, points = raster.covered, interpolate(raster, faces, vertices)
    normals = normalized(interpolate(raster, faces, vertex_normals(vertices, faces)))
    place = interpolate(raster, faces, np.column_stack([1 - refined[:, 1], refined[:, 0]]))

    def log_odds(model_from_scan: FloatArray, face_scale: float) -> float:
        sized = model.front + face_scale * (points[covered] - model.front)
        hits = surface.query(transform_points(invert_rigid(model_from_scan), sized))
        color, shown = scan_colors(scan, hits.face * stride, hits.barycentric)
        near = shown & (hits.distance < _NEAR_MM) & (color.max(1) > 0)
        if near.mean() < _LEAST_SEEN:
            return 0.0
        texture, seen = np.zeros((*covered.shape, 3), np.float32), covered.copy()
        texture[covered], seen[covered] = color, near
        looks = chart_materials(face_scale * points, normals, seen, texture, place=place)
        # Noise, paint or another's picture look like a wrong pose: they alone must not refuse a face.
        return float(np.clip(looks.log_odds, -2, 3))

    return log_odds
