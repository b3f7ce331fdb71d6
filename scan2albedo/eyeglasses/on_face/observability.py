"""How well the pictures fix a frame, point by point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scan2albedo.eyeglasses.on_face.frame_motion import FrameMotion, SkinnedPoints
from scan2albedo.eyeglasses.on_face.registration_terms import Linearization
from scan2albedo.geometry.mesh import normalized

FloatArray = NDArray[np.float64]

_RIDGE = 1e-12
"""Least eigenvalue of the scaled matrix, as a part of the largest: open directions stay finite."""
_MEDIAN_OF_RAYLEIGH, _MEDIAN_OF_NORMAL = 1.1774, 0.6745
"""Medians of a label's distance and of an outline's absolute error at a deviation of 1 a coordinate."""


@dataclass(frozen=True)
class Noise:
    """Standard deviations in pixels that the fit's own residuals show."""

    label_px: float
    outline_px: float


def measured_noise(at: Linearization, least_px: float, otherwise: Noise) -> Noise:
    """Return robust deviations of labels and outlines, `otherwise` where fewer than five tell."""
    labels = at.labels_px[np.isfinite(at.labels_px)]
    outline = np.abs(at.outline_px[np.isfinite(at.outline_px)])
    label_px, outline_px = otherwise.label_px, otherwise.outline_px
    if len(labels) > 4:
        label_px = max(least_px, float(np.median(labels)) / _MEDIAN_OF_RAYLEIGH)
    if len(outline) > 4:
        outline_px = max(least_px, float(np.median(outline)) / _MEDIAN_OF_NORMAL)
    return Noise(label_px, outline_px)


class PointDeviations:
    """Standard deviations of the frame's points, from the Gauss-Newton matrix of cost in squared deviations.

    Parameters
    ----------
    motion : FrameMotion
    matrix : (P, P) float64
        P = 6 for a rigid frame, 6 + 3 K otherwise.
    """

    def __init__(self, motion: FrameMotion, matrix: FloatArray) -> None:
        self._motion = motion
        scale = np.sqrt(np.maximum(np.diag(matrix), 1e-30))
        values, vectors = np.linalg.eigh(matrix / scale[:, None] / scale)
        values = np.maximum(values, _RIDGE * values.max())
        self._root = vectors / np.sqrt(values) / scale[:, None]

    def covariances(self, points: SkinnedPoints) -> FloatArray:
        """Return (N, 3, 3) of points in the world."""
        return self._motion.covariances(points, self._root)


def worst_deviation(covariances: FloatArray) -> FloatArray:
    """Return (N,) standard deviations in the worst direction."""
    return np.sqrt(np.maximum(np.linalg.eigvalsh(covariances)[:, -1], 0.0))


def deviation_along(covariances: FloatArray, directions: FloatArray) -> FloatArray:
    """Return (N,) standard deviations along directions (N, 3)."""
    heading = normalized(directions)
    return np.sqrt(np.maximum(np.einsum("ni,nij,nj->n", heading, covariances, heading), 0.0))
