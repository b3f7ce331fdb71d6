"""What speaks for a face at a pose, once the template has its shape, and the odds of one there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2albedo.core import Meter
from scan2albedo.core.arrays import FloatArray
from scan2albedo.geometry.rigid import Similarity
from scan2albedo.registration.icp import residuals, shaped_icp
from scan2albedo.registration.relief import ReliefAgreement
from scan2albedo.registration.scan_preparation import PreparedScan
from scan2albedo.registration.template import Template

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
