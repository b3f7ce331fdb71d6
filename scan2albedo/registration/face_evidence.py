"""How much a posed scan looks like a face: relief correlation of depth images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scan2albedo.geometry.depth_image import DepthFrame, depth_image

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

_SIZE = 72
_LOOK_THROUGH_MM = 30.0
_SAME_SURFACE_MM = 20.0
_STEEPEST_SLOPE = 1.5


@dataclass(frozen=True)
class FaceEvidence:
    """What the depth images of the posed scan and the model have in common.

    Parameters
    ----------
    coverage : float
        Part of the model's image where the scan lies within 20 mm of it.
    relief_correlation : float
        Correlation of the depth derivatives there, after a quadratic fit is taken out of each: the
        bulge that a head shares with a ball does not count, nose, orbits and mouth do.
    median_mm : float
        Median absolute depth difference there.
    """

    coverage: float
    relief_correlation: float
    median_mm: float

    @property
    def score(self) -> float:
        """Relief correlation, lessened where little of the face is covered."""
        return self.relief_correlation * min(1.0, self.coverage / 0.6) ** 0.5


class FaceImage:
    """The model's depth image, against which posed scans are judged.

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
        self._highest_mm = float(high[2]) + _LOOK_THROUGH_MM

    def evidence(
        self, vertices: FloatArray, faces: NDArray[np.int64], model_from_scan: FloatArray
    ) -> FaceEvidence:
        """Judge a scan under a (4, 4) transform into the model's frame (rigid or similarity)."""
        seen = depth_image(vertices, faces, self.frame, model_from_scan, z_limit=self._highest_mm)
        in_model = np.isfinite(self.depth)
        difference = np.where(in_model, seen, np.inf) - np.where(in_model, self.depth, 0.0)
        common = np.abs(difference) < _SAME_SURFACE_MM
        coverage = float(common.sum() / in_model.sum())
        if common.sum() < 64:
            return FaceEvidence(coverage, 0.0, _SAME_SURFACE_MM)
        relief = [_relief(image, common, self.frame.pixel) for image in (seen, self.depth)]
        return FaceEvidence(coverage, _correlation(*relief), float(np.median(np.abs(difference[common]))))


def _relief(depth: FloatArray, mask: Mask, pixel: float) -> FloatArray:
    """Return both slopes at the masked pixel pairs, (2 P,), each without its quadratic trend."""
    across, down = mask[:, 1:] & mask[:, :-1], mask[1:] & mask[:-1]
    filled = np.where(mask, depth, 0.0)
    slopes = (
        (np.diff(filled, axis=1)[across], np.argwhere(across)),
        (np.diff(filled, axis=0)[down], np.argwhere(down)),
    )
    return np.concatenate(
        [_without_trend(np.clip(s / pixel, -_STEEPEST_SLOPE, _STEEPEST_SLOPE), at) for s, at in slopes]
    )


def _without_trend(values: FloatArray, position: NDArray[np.int64]) -> FloatArray:
    row, column = (position / _SIZE - 0.5).T
    basis = np.stack([np.ones_like(row), row, column, row * row, row * column, column * column], 1)
    gram = basis.T @ basis + 1e-9 * len(basis) * np.eye(6)
    return values - basis @ np.linalg.solve(gram, basis.T @ values)


def _correlation(a: FloatArray, b: FloatArray) -> float:
    norm = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / norm if norm > 0 else 0.0
