"""How much a posed scan looks like a face: relief correlation of depth images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from scan2albedo.geometry.depth_image import DepthFrame, depth_image
from scan2albedo.registration.relief import correlation, without_quadratic_trend

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Mask = NDArray[np.bool_]

_SIZE = 72
_LOOK_THROUGH_MM = 30.0
_SAME_SURFACE_MM = 20.0
_STEEPEST_SLOPE = 1.5
_SMOOTHING_PIXELS = 1.5
_FEATURE_PIXELS = 5.0
_FEWEST_PIXELS = 64


@dataclass(frozen=True)
class FaceEvidence:
    """What the depth images of the posed scan and the model have in common.

    Parameters
    ----------
    coverage : float
        Part of the model's features within 20 mm of which the scan lies.
    relief_correlation : float
        Correlation of the depth derivatives there, after a quadratic fit is taken out of each: the
        bulge that a head shares with a ball does not count, nose, orbits and mouth do.
    """

    coverage: float
    relief_correlation: float

    @property
    def score(self) -> float:
        """Relief correlation, lessened where little of the face is covered."""
        return self.relief_correlation * min(1.0, self.coverage / 0.6) ** 0.5


class FaceImage:
    """The model's depth image, against which posed scans are judged.

    Pixels count by how much relief the model has around them: noise on a smooth forehead says
    nothing, a nose does.

    Parameters
    ----------
    vertices, faces : (V, 3) float64 mm, (F, 3) int64
        The model's surface in its own frame.
    """

    def __init__(self, vertices: FloatArray, faces: NDArray[np.int64]) -> None:
        low, high = vertices.min(0), vertices.max(0)
        center = (low + high) / 2
        self.frame = DepthFrame((float(center[0]), float(center[1])), 1.02 * float(np.max(high - low)), _SIZE)
        self.depth = depth_image(vertices, faces, self.frame)
        self._inside = np.isfinite(self.depth)
        self._highest_mm = float(high[2]) + _LOOK_THROUGH_MM
        self._weights = self._feature_weights()

    def _feature_weights(self) -> FloatArray:
        """Return (S, S) squared relief, blurred to features; 0 outside the model."""
        energy = np.zeros_like(self.depth)
        for slopes, row, column in _slopes(self.depth, self._inside, self.frame.pixel, 0.0):
            energy[row, column] += _without_trend(slopes, row, column, np.ones(len(row))) ** 2
        return gaussian_filter(energy, _FEATURE_PIXELS) * self._inside

    def evidence(
        self, vertices: FloatArray, faces: NDArray[np.int64], model_from_scan: FloatArray
    ) -> FaceEvidence:
        """Judge a scan under a (4, 4) transform into the model's frame (rigid or similarity)."""
        seen = depth_image(vertices, faces, self.frame, model_from_scan, z_limit=self._highest_mm)
        difference = np.where(self._inside, seen, np.inf) - np.where(self._inside, self.depth, 0.0)
        common = np.abs(difference) < _SAME_SURFACE_MM
        coverage = float(self._weights[common].sum() / self._weights.sum())
        if common.sum() < _FEWEST_PIXELS:
            return FaceEvidence(coverage, 0.0)
        a, b = self._relief(seen, common), self._relief(self.depth, common)
        return FaceEvidence(coverage, correlation(a[0], b[0], a[1]))

    def _relief(self, depth: FloatArray, common: Mask) -> tuple[FloatArray, FloatArray]:
        """Return slopes without their trend and their weights, (P,) each, both axes in one row."""
        values, weights = [], []
        for slopes, row, column in _slopes(depth, common, self.frame.pixel, _SMOOTHING_PIXELS):
            weights.append(self._weights[row, column])
            values.append(_without_trend(slopes, row, column, weights[-1]))
        return np.concatenate(values), np.concatenate(weights)


def _slopes(
    depth: FloatArray, mask: Mask, pixel_mm: float, smoothing: float
) -> tuple[tuple[FloatArray, IntArray, IntArray], ...]:
    """Return, across and down, the slopes (P,) between neighbours in the mask and their (row, column)."""
    smooth = _smoothed(depth, mask, smoothing)
    across, down = mask[:, 1:] & mask[:, :-1], mask[1:] & mask[:-1]
    found = []
    for difference, both in ((np.diff(smooth, axis=1), across), (np.diff(smooth, axis=0), down)):
        row, column = np.nonzero(both)
        found.append((np.clip(difference[both] / pixel_mm, -_STEEPEST_SLOPE, _STEEPEST_SLOPE), row, column))
    return tuple(found)


def _smoothed(depth: FloatArray, mask: Mask, sigma: float) -> FloatArray:
    """Return the depth blurred within the mask, 0 outside."""
    filled = np.where(mask, depth, 0.0)
    if sigma == 0:
        return filled
    weight = gaussian_filter(mask.astype(np.float64), sigma)
    return np.where(mask, gaussian_filter(filled, sigma) / np.maximum(weight, 1e-9), 0.0)


def _without_trend(slopes: FloatArray, row: IntArray, column: IntArray, weights: FloatArray) -> FloatArray:
    return without_quadratic_trend(slopes, np.stack([row, column], 1) / _SIZE - 0.5, weights)
