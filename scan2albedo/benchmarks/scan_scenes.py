"""Raw synthetic scans whose pose, surface and correspondence are known; registration and fit share them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray

from scan2albedo.face_model import AnnotatedFaceModel
from scan2albedo.geometry.rigid import procrustes
from scan2albedo.io.raw_scan import RawScan
from scan2albedo.synthetic import RawScanOptions, SyntheticTruth, raw_scan

FloatArray = NDArray[np.float64]

EXPRESSIONS = ("neutral", "smile", "surprise", "frown", "pout", "puff")
_PICTURE, _TRUTH = 48, 128
"""Pixels and texels: nothing here looks at colour."""
_RIGID = slice(17, 48)
"""iBUG-68: brows, nose and eyes, which no expression moves far."""


@dataclass(frozen=True)
class ScanScene:
    """A raw scan in a random pose, and its truth."""

    scan: RawScan
    truth: SyntheticTruth
    model: AnnotatedFaceModel

    @cached_property
    def model_from_scan(self) -> FloatArray:
        """(4, 4) the pose that lays the person's brows, nose and eyes best on the model's.

        Two people's faces have no common pose of their own: this is a definition.
        """
        landmarks = self.model.landmarks
        assert landmarks is not None
        from_truth = procrustes(self.truth.landmarks[_RIGID], landmarks[_RIGID])
        return from_truth @ self.truth.model_from_scan

    @property
    def surface(self) -> FloatArray:
        """(N, 3) points of the true surface in the truth's frame, mm."""
        return self.truth.image.position[self.truth.image.mask].astype(np.float64)

    def limit_points(self, level: int) -> FloatArray:
        """Return the true places (V, 3) of the model's surface vertices of a level, in the truth's frame."""
        return self.model.subdivision(level).matrix @ self.truth.control_points


@cache
def scan_scenes(count: int, spacing_mm: float = 2.2) -> tuple[ScanScene, ...]:
    """Return scans of `count` people, each with another expression, in random poses."""
    model = AnnotatedFaceModel.default()
    options = RawScanOptions(picture_size=_PICTURE, size=_TRUTH, spacing_mm=spacing_mm)
    scenes = []
    for seed in range(count):
        expression = EXPRESSIONS[seed % len(EXPRESSIONS)]
        scan, truth = raw_scan(seed, expression=expression, model=model, options=options)  # type: ignore[arg-type]
        scenes.append(ScanScene(scan, truth, model))
    return tuple(scenes)
