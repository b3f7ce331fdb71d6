"""Holes of a scan between lids and lips: scanners lose what is wet, and so show where eyes and mouth open."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy import sparse

from scan2albedo.core.arrays import FloatArray
from scan2albedo.face_model import AnnotatedSurface
from scan2albedo.face_model.annotation import LANDMARK_LEVELS
from scan2albedo.fitting.landmark_pull import SHOWN_BY_HOLE, LandmarkPull
from scan2albedo.fitting.scan_surface import ScanSurface
from scan2albedo.geometry.mesh import boundary_loops

EYES = (tuple(range(36, 42)), tuple(range(42, 48)))
"""iBUG-68, the subject's right eye first."""
INNER_LIPS = tuple(range(60, 68))
_REACH_MM = 25.0
"""A registered face has its eyes, and the middle of its lips, this near to the model's."""
_EYE_MM = ((16.0, 36.0), (4.0, 25.0))
_MOUTH_MM = ((20.0, 75.0), (4.0, 50.0))
"""Width and height of holes that may be an opening, with what a scanner loses around it."""
_APART_MM = (50.0, 78.0)
"""Between the middles of people's eyes."""
_LEVEL_MM = 5.0
_ALIKE = (1.3, 1.8)
"""One eye's hole is at most so much wider and higher than the other's: else more is missing than an eye."""
_ASIDE_MM = 4.0
"""The middle between both eyes, or between a mouth's ends, is this near to the model's midline."""
_MIDDLE_MM, _END_MM = 1.5, 3.0
"""Standard deviations of the middle of a hole and its ends from those of the opening."""


@dataclass(frozen=True)
class _Hole:
    """`middle` (3,), the `ends` (2, 3) on the subject's right and left, `width_mm` and `height_mm`."""

    middle: FloatArray
    ends: FloatArray
    width_mm: float
    height_mm: float

    @classmethod
    def of(cls, points: FloatArray) -> _Hole:
        """Return the hole with a border (N, 3)."""
        after = np.roll(points, -1, axis=0)
        edges = np.linalg.norm(after - points, axis=1)
        middle = edges @ (after + points) / 2 / max(float(edges.sum()), 1e-12)
        ends = points[[np.argmin(points[:, 0]), np.argmax(points[:, 0])]]
        width, height, _ = np.ptp(points, axis=0)
        return cls(middle, ends, float(width), float(height))

    def has_size(self, size: tuple[tuple[float, float], tuple[float, float]]) -> bool:
        """Whether width and height lie in their ranges."""
        (least, most), (lowest, highest) = size
        return least < self.width_mm < most and lowest < self.height_mm < highest

    def distance_mm(self, point: FloatArray) -> float:
        """Return how far the middle is from a point."""
        return float(np.linalg.norm(self.middle - point))

    def rows(
        self, whole: tuple[int, ...], ends: tuple[int, int]
    ) -> Iterator[tuple[FloatArray, FloatArray, float]]:
        """Yield weights (68,) of landmarks, the point (3,) they belong on, and its standard deviation."""
        yield np.eye(68)[list(whole)].mean(0), self.middle, _MIDDLE_MM
        for number, end in zip(ends, self.ends, strict=True):
            yield np.eye(68)[number], end, _END_MM


def openings(scan: ScanSurface, model: AnnotatedSurface) -> LandmarkPull | None:
    """Return the pull of lids and lips to the holes that they surround; None where the scan has none.

    The scan lies in the model's frame, registered. Two holes are eyes when both have about the size of an
    opening between lids, lie level, as far apart as people's eyes, and near the model's; one is a mouth when
    it has the size of one, on the midline and near the model's.
    """
    landmarks = model.landmarks
    if landmarks is None or model.landmark_points is None or not scan.boundary.any():
        return None
    holes = [_Hole.of(scan.vertices[loop]) for loop in boundary_loops(scan.faces)]
    eyes, mouth = [*_eyes(holes, landmarks)], [*_mouth(holes, landmarks)]
    if not eyes and not mouth:
        return None
    weights, targets, sigma_mm = (np.array(column) for column in zip(*eyes, *mouth, strict=True))
    every = model.subdivision(LANDMARK_LEVELS).points_matrix(model.landmark_points)
    is_eye = np.arange(len(targets)) < len(eyes)
    return LandmarkPull(
        numbers=np.full(len(targets), SHOWN_BY_HOLE),
        matrix=(sparse.csr_matrix(weights) @ every).tocsr(),
        targets=targets,
        sigma_mm=sigma_mm,
        wrong_mm=np.full(len(targets), 2 * _REACH_MM),
        # The border of a hole may lie deep between lids or lips.
        axes=np.ones((len(targets), 3)) * (1.0, 1.0, 0.0),
        still=is_eye,
    )


def _eyes(holes: list[_Hole], landmarks: FloatArray) -> Iterator[tuple[FloatArray, FloatArray, float]]:
    middles = [landmarks[list(eye)].mean(0) for eye in EYES]
    near = [[h for h in holes if h.has_size(_EYE_MM) and h.distance_mm(m) < _REACH_MM] for m in middles]
    pairs = []
    for right, left in product(*near):
        apart, up, _ = left.middle - right.middle
        sizes = (right.width_mm, left.width_mm), (right.height_mm, left.height_mm)
        alike = all(max(pair) < ratio * min(pair) for pair, ratio in zip(sizes, _ALIKE, strict=True))
        aside = (right.middle + left.middle)[0] / 2 - np.mean(middles, axis=0)[0]
        level = abs(up) < _LEVEL_MM and abs(aside) < _ASIDE_MM
        if _APART_MM[0] < apart < _APART_MM[1] and level and alike:
            pairs.append((right, left))
    if not pairs:
        return
    best = min(pairs, key=lambda pair: sum(h.distance_mm(m) for h, m in zip(pair, middles, strict=True)))
    for eye, hole in zip(EYES, best, strict=True):
        yield from hole.rows(eye, (eye[0], eye[3]))


def _mouth(holes: list[_Hole], landmarks: FloatArray) -> Iterator[tuple[FloatArray, FloatArray, float]]:
    middle = landmarks[list(INNER_LIPS)].mean(0)
    found = [
        hole
        for hole in holes
        if hole.has_size(_MOUTH_MM)
        and hole.distance_mm(middle) < _REACH_MM
        and abs(hole.ends[:, 0].mean() - middle[0]) < _ASIDE_MM
        and abs(hole.ends[1, 1] - hole.ends[0, 1]) < _LEVEL_MM
    ]
    if found:
        widest = max(found, key=lambda hole: hole.width_mm)
        yield from widest.rows(INNER_LIPS, (INNER_LIPS[0], INNER_LIPS[4]))
