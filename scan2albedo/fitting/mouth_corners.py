"""Draw the corners of the model's mouth back before it bends, as a smile does, or together, as a pout does.

Closest points slide no corner along a surface; so smiling models are tried, and chosen, each side for itself,
by whether a coarse fit reaches into the crease of the cheek.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.face_model import AnnotatedSurface
from scan2albedo.fitting.mouth_opening import REACH_MM
from scan2albedo.fitting.samples import SurfaceSamples, surface_normals
from scan2albedo.fitting.scan_surface import ScanSurface
from scan2albedo.fitting.stages import TRIAL_LEVEL, Deformation, coarsely_fitted
from scan2albedo.geometry.closest_points import NearestSurface
from scan2albedo.geometry.mesh import normalized

CORNERS = (48, 54)
"""iBUG-68 indices of the corners of the mouth, the subject's right side first."""
BESIDE_MM, ABOVE_MM = 15.0, 14.0
"""How far beside and above the corners the skin follows them (standard deviations)."""
FIRST_MM = (0.0, -7.0, 10.0)
FURTHER_MM = {-14.0: -7.0, 15.0: 10.0}
"""Pulls in mm, above 0 back and below 0 together: those tried on every scan, and those tried when the pull
that they are mapped to has gained."""
WORTH, MIN_GAIN, NARROWER_GAIN = 0.2, 0.34, 0.03
"""Shares of the distance: what 10 mm must save for 15 mm to be tried, and what a pull's coarse fit saves.
Drawn back: shut mouths up to 0.32, smiles from 0.35 on. Drawn together: most puffed cheeks and puckered lips
0.03 to 0.24, other mouths none."""
ZONE_MM, MIN_COSINE = 45.0, 0.2
"""Scan this near to the middle of the mouth is compared: the mouth, and the cheek that a smile folds. Used is
what has normals within 78 degrees of the model's; distances are cut off at REACH_MM."""


def corners_pulled(deformation: Deformation) -> Deformation:
    """Return the deformation that starts from the corners of the mouth drawn back, or together."""
    reference, meter = deformation.reference, deformation.meter
    if meter.exhausted:
        return deformation
    corners = MouthCorners.of(deformation.model, reference)
    if corners is None:
        return deformation
    mouth = MouthScan.of(deformation.model, reference, deformation.scan, TRIAL_LEVEL)
    reached: dict[float, FloatArray] = {}
    for mm in (*FIRST_MM, *FURTHER_MM):
        if meter.exhausted:
            return deformation
        if mm in FURTHER_MM and not mouth.gains(reached, FURTHER_MM[mm]):
            continue
        reached[mm] = coarsely_fitted(deformation, corners.pulled(reference, (mm, mm)) if mm else reference)
    pull = mouth.chosen(reached)
    return replace(deformation, reference=corners.pulled(reference, pull), corners_mm=pull)


@dataclass(frozen=True)
class MouthCorners:
    """How the control points move when the corners are pulled a mm: `right`, `left` (C, 3)."""

    right: FloatArray
    left: FloatArray

    @classmethod
    def of(cls, model: AnnotatedSurface, control_points: FloatArray) -> MouthCorners | None:
        """Return a model's pulls, toward the jaw line's ends at the ears; None without landmarks."""
        landmarks = model.landmarks_of(control_points)
        if landmarks is None:
            return None
        corners = landmarks[list(CORNERS)]
        middle, half_width = corners.mean(0), 0.5 * max(float(np.linalg.norm(corners[1] - corners[0])), 1e-6)
        across, above = (control_points - middle)[:, :2].T
        beside = np.maximum(np.abs(across) - half_width, 0)
        share = np.minimum(np.abs(across) / half_width, 1) * np.exp(-0.5 * (beside / BESIDE_MM) ** 2)
        share = share * np.exp(-0.5 * (above / ABOVE_MM) ** 2)
        toward = normalized(landmarks[[0, 16]] - corners)
        return cls(
            np.where(across < 0, share, 0.0)[:, None] * toward[0],
            np.where(across > 0, share, 0.0)[:, None] * toward[1],
        )

    def pulled(self, control_points: FloatArray, mm: tuple[float, float]) -> FloatArray:
        """Return the control points (C, 3) with the right and the left corner pulled."""
        return control_points + mm[0] * self.right + mm[1] * self.left


@dataclass(frozen=True)
class MouthScan:
    """The scan within ZONE_MM of the mouth, to measure how near a face is to it.

    `points` and unit `normals` are (N, 3), `left` (N,) marks the subject's left; `samples` are the model's.
    """

    points: FloatArray
    normals: FloatArray
    left: BoolArray
    samples: SurfaceSamples

    @classmethod
    def of(
        cls, model: AnnotatedSurface, control_points: FloatArray, scan: ScanSurface, level: int
    ) -> MouthScan:
        """Take the scan within ZONE_MM of the mouth of an annotated model."""
        landmarks = model.landmarks_of(control_points)
        assert landmarks is not None
        middle = landmarks[list(CORNERS)].mean(0)
        near = np.linalg.norm(scan.vertices - middle, axis=1) < ZONE_MM
        points = scan.vertices[near]
        samples = SurfaceSamples.of(model, control_points, level)
        return cls(points, scan.normals[near], points[:, 0] > middle[0], samples)

    def distances(self, control_points: FloatArray) -> tuple[float, float]:
        """Return the mean distance of the scan from the model, mm, on the right and on the left.

        Scan whose normal disagrees is left out, distances are cut off at REACH_MM; NaN on a side without any.
        """
        surface, faces = self.samples.matrix @ control_points, self.samples.faces
        hits = NearestSurface(surface, faces).query(self.points)
        normals = surface_normals(surface, faces)[0][faces[hits.face]]
        across = normalized(np.einsum("nk,nkj->nj", hits.barycentric, normals))
        facing = np.einsum("ij,ij->i", across, self.normals) > MIN_COSINE
        distance = np.minimum(hits.distance, REACH_MM)
        right, left = distance[facing & ~self.left], distance[facing & self.left]
        return float(right.mean()) if len(right) else np.nan, float(left.mean()) if len(left) else np.nan

    def gains(self, reached: dict[float, FloatArray], mm: float) -> bool:
        """Whether the coarse fit of a pull ended enough nearer for one beyond it to be tried."""
        saved = _saved(self.distances(reached[0.0]), self.distances(reached[mm]))
        return max(saved) > (WORTH if mm > 0 else 0.0)

    def chosen(self, reached: dict[float, FloatArray]) -> tuple[float, float]:
        """Return the pulls in mm of the right and the left corner whose coarse fits ended nearest.

        `reached` holds the control points after each pull's coarse fit, 0 mm among them. A side is drawn back
        only when it gains MIN_GAIN; both are drawn together when they gain NARROWER_GAIN on average.
        """
        found = {mm: self.distances(points) for mm, points in reached.items()}
        saved = {mm: _saved(found[0.0], distances) for mm, distances in found.items()}
        narrower = max((mm for mm in saved if mm <= 0), key=lambda mm: sum(saved[mm]))
        if sum(saved[narrower]) / 2 > NARROWER_GAIN:
            return narrower, narrower
        right, left = (max(saved, key=lambda mm: saved[mm][side]) for side in (0, 1))
        return (right if saved[right][0] > MIN_GAIN else 0.0, left if saved[left][1] > MIN_GAIN else 0.0)


def _saved(before: tuple[float, float], after: tuple[float, float]) -> tuple[float, float]:
    """Return which part of the distance is saved, right and left; 0 where either is unknown."""
    right, left = (
        1 - new / old if old > 0 and new >= 0 else 0.0 for old, new in zip(before, after, strict=True)
    )
    return right, left
