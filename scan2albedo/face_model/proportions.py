"""Whether the proportions of a face, known by its landmarks, can be a person's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2albedo.core.arrays import FloatArray
from scan2albedo.face_model.annotation import default_model
from scan2albedo.geometry.rigid import procrustes, transform_points

UPPER = np.arange(17, 48)
"""Brows, nose and eyes (iBUG-68), which jaw and lips do not move."""
UPPER_AND_SIDES = np.concatenate([np.arange(4), np.arange(13, 48)])
NOSE_TIP, OUTER_EYES = 30, [36, 45]
MEAN = np.array([0.017, -0.031, -0.043])
COVARIANCE = np.array(
    [[0.00261, 0.00074, -0.00189], [0.00074, 0.00545, 0.00255], [-0.00189, 0.00255, 0.00692]]
)
"""Of the logarithms, over 324 fits: half the weight on nine measured people, each with other expressions,
noise and holes, half on 164 synthetic ones."""
FARTHEST = 3.5
"""Distance that no person's proportions have: those of the 324 reach 3.1, and 3.4 when a person is judged by
all others. Stretched 1.5 x or 0.67 x along an axis, 28 of 29 faces are beyond it, 1.3 x or 0.77 x 63 %."""
RATIOS = ("width to height", "depth to height", "depth of the nose to the width of the eyes")


@dataclass(frozen=True)
class Proportions:
    """Proportions of a face relative to the default model's.

    `logarithms` (3,) are those of width / height and depth / height, and of the nose's depth before the outer
    corners of the eyes / their distance.
    """

    logarithms: FloatArray

    @property
    def distance(self) -> float:
        """Mahalanobis distance to people's faces."""
        off = self.logarithms - MEAN
        return float(np.sqrt(off @ np.linalg.solve(COVARIANCE, off)))

    def doubt(self) -> str:
        """Return the ratios in words, beside people's; nothing where they may be a person's."""
        if self.distance <= FARTHEST:
            return ""
        reach = 3 * np.sqrt(np.diag(COVARIANCE))
        rows = zip(RATIOS, *np.exp([self.logarithms, MEAN - reach, MEAN + reach]), strict=True)
        return ", ".join(f"{name} {ratio:.2f} ({low:.2f} to {high:.2f})" for name, ratio, low, high in rows)


def proportions(landmarks: FloatArray) -> Proportions:
    """Return the proportions of a face with landmarks (68, 3) in the axes of a face model, in any unit.

    Width, height and depth are the diagonal of the stretch in the affine map (a rotation after a stretch)
    that takes the default model's landmarks to these in the least-squares sense.
    """
    reference = default_model().landmarks
    assert reference is not None
    stretch = _stretch(reference[UPPER_AND_SIDES], landmarks[UPPER_AND_SIDES])
    width, height, depth = np.log(np.maximum(np.diag(stretch), 1e-9))
    nose = np.log(_nose_depth(landmarks, reference) / _nose_depth(reference, reference))
    return Proportions(np.array([width - height, depth - height, nose]))


def _stretch(source: FloatArray, target: FloatArray) -> FloatArray:
    """Return the symmetric (3, 3) factor S of the affine map R S between points (N, 3)."""
    x, y = source - source.mean(0), target - target.mean(0)
    affine = np.linalg.lstsq(x, y, rcond=None)[0].T
    _, singular, vt = np.linalg.svd(affine)
    return (vt.T * singular) @ vt


def _nose_depth(landmarks: FloatArray, reference: FloatArray) -> float:
    """Return how far the nose's tip is before the outer corners of the eyes, relative to their distance."""
    upright = transform_points(procrustes(landmarks[UPPER], reference[UPPER]), landmarks)
    right, left = upright[OUTER_EYES]
    depth = upright[NOSE_TIP, 2] - (right[2] + left[2]) / 2
    return max(float(depth / np.linalg.norm(left - right)), 1e-3)
