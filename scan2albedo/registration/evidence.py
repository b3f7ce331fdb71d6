"""What speaks for a face at a pose, once the template has its shape, and the odds of one there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from scan2albedo.core import Meter
from scan2albedo.core.arrays import FloatArray
from scan2albedo.geometry.rigid import Similarity
from scan2albedo.registration.icp import proportions, residuals, shaped_icp
from scan2albedo.registration.relief import ReliefAgreement
from scan2albedo.registration.scan_preparation import PreparedScan
from scan2albedo.registration.template import Template

_MOST_RMS_MM, _LEAST_SHARE = 10.0, 0.02
_NOISE_IN_DISTANCE = 0.3
"""Part of the noise's variance that the squared distance holds: it is to samples averaged over 4 mm."""
_INTERCEPT, _WEIGHTS = -10.18, {"relief": 14.9, "local": 5.0, "distance": -0.58, "share": 2.29}
"""Of the cues in the log odds: a logistic regression, by tools/calibrate_registration.py --scans 100."""
_USUAL_PROPORTIONS = np.array([-0.03, -0.06, -0.04])
"""People's mean of `icp.proportions`: half-way from the template's to that of light-stage people."""
_STRANGE_PROPORTION, _PROPORTION_WIDTH = 0.32, 0.025
"""How far from people's mean, in logarithms, the odds of a person's proportions are even, and how far from
there they change by e. Of synthetic people 99 % are within 0.30 of the template's (see
tools/calibrate_registration.py), mixtures of light-stage people within 0.30 of the mean; faces stretched by
half are 0.27 to 0.49 from it."""


@dataclass(frozen=True)
class Evidence:
    """Agreement of the scan with the shaped template at its pose.

    `pose` is `scan_from_model`, `coefficients` (K,) are those of the template's modes in standard deviations.
    `share` is the part of the template's area with scan within 10 mm that faces the same way, `rms_mm` the
    distance there; `relief` compares their depth images, `proportions` (3,) see `icp`.
    """

    pose: Similarity
    coefficients: FloatArray
    share: float
    rms_mm: float
    relief: ReliefAgreement
    proportions: FloatArray

    @property
    def cues(self) -> dict[str, float]:
        """The values that are weighed, each finite, as they would be about without the scan's noise."""
        local, whole = self.relief.without_noise()
        noise = _NOISE_IN_DISTANCE * self.relief.noise_mm**2
        return {
            "relief": whole,
            "local": local,
            "distance": max(min(self.rms_mm, _MOST_RMS_MM) ** 2 - noise, 0.0),
            "share": float(np.log(max(self.share, _LEAST_SHARE))),
        }

    @property
    def log_odds(self) -> float:
        """Logarithm of the odds that the pose is that of a face, by its shape alone."""
        cues = self.cues
        return _INTERCEPT + sum(weight * cues[name] for name, weight in _WEIGHTS.items())

    @property
    def person(self) -> float:
        """Probability that a face of these proportions is a person's."""
        strange = float(np.abs(self.proportions - _USUAL_PROPORTIONS).max())
        return float(expit((_STRANGE_PROPORTION - strange) / _PROPORTION_WIDTH))


def evidence(scan: PreparedScan, template: Template, start: Similarity, meter: Meter) -> Evidence:
    """Fit pose and shape of the template from a start, and measure how the scan agrees with it."""
    shaped = shaped_icp(scan.samples, template, start, meter)
    samples = template.in_shape(shaped.coefficients).samples
    measured = residuals(scan.samples, samples, shaped.pose)
    moved = np.tensordot(shaped.coefficients, template.control_modes, 1)
    surface = template.image.vertices + template.surface_from_control @ moved
    inverse = shaped.pose.inverse()
    return Evidence(
        shaped.pose,
        shaped.coefficients,
        float(samples.areas[measured.inlier].sum() / samples.areas.sum()),
        measured.trimmed_rms_mm(samples.areas),
        template.image.agreement(scan.vertices, scan.faces, inverse, surface, scan.noise),
        proportions(scan.samples, template, shaped),
    )
