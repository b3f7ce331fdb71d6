"""What a fitted face shows that no scan of one whole person does: parts without scan, unlike halves.

Thresholds lie above what 324 fits to faces gave: 164 synthetic people (raw stereo with hair, beards and
glasses; smiles and puffed cheeks of one side), five measured heads with twelve expressions of both sides or
one, and four raw scans.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from scan2albedo.core import PlanStep
from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.face_model import AnnotatedSurface
from scan2albedo.face_model.annotation import FILLED_REGION, MOUTH_REGION, REST_REGION
from scan2albedo.face_model.proportions import proportions
from scan2albedo.fitting.result import FittedFace
from scan2albedo.geometry.mesh import face_areas, vertex_areas, vertex_normals
from scan2albedo.geometry.rigid import procrustes, transform_points

PARTS = {
    "nose": ((30, 33), 12.0),
    "right eye": (tuple(range(36, 42)), 16.0),
    "left eye": (tuple(range(42, 48)), 16.0),
    "mouth": (tuple(range(48, 60)), 20.0),
    "chin": ((8, 8, 57), 10.0),
}
"""Of each part the landmarks about whose mean it lies, and its radius in mm."""
LEAST_OF_A_PART = 0.25
"""Covered part of its area below which a part has no scan. With a hole of 18 mm radius or more it is below
0.01, without one above 0.5 but where the scan ends there."""

UNLIKE_MM, CLEAN_MM = 1.3, 0.15
"""Differences of the halves, and steps at the midline, that no person's face has: they reach 0.9 of it. Where
the fit is farther from the scan than `CLEAN_MM` in the mean, noise and hair add to them."""
UPPER_ABOVE_MM = -49.0
"""The upper face, which expressions hardly move, begins so far above the nasion."""
MIDDLE_MM = (-94.0, 26.0)
HALF_WIDTH_MM = 66.0
"""The middle of the face, which hair hardly covers: heights above the nasion, and its half width."""
MIDLINE_MM, MIDLINE_HEIGHT_MM = (2.0, 12.0), (-10.0, 32.0)
"""The strip beside the midline between the brows, where neither lips nor hair move it: distances from the
midline, and heights above the nasion."""
UPPER_PATCH_MM, MIDDLE_PATCH_MM = 22.0, 26.0
"""Sides of the patches over which differences are averaged, against noise."""
LEAST_OF_A_PATCH, LEAST_OF_A_REGION = 0.4, 0.6
"""Part of the area that must be seen on both sides."""
MIRROR_TOLERANCE_MM = 0.1
"""Farthest a vertex of a mirror-symmetric model is from the mirror image of its twin."""
LEVEL = 1
"""Refinements at which halves are compared."""
ITERATIONS, ROBUST_MM = 6, 1.0
"""Of laying the mirror image on the face: distances above `ROBUST_MM` count less and less."""


def doubts(fitted: FittedFace) -> Iterator[PlanStep]:
    """Yield a row for each thing about a fitted face that scans of one whole person do not have."""
    if missing := missing_parts(fitted):
        names = " and ".join(filter(None, (", ".join(missing[:-1]), missing[-1])))
        reason = f"no scan near the {names} (a hole, glasses, a beard?): the shape there is the model's own"
        yield PlanStep.doubt("fit.missing", reason)
    found = asymmetry(fitted)
    if found is not None and found.unlikeness > 1:
        reason = "asymmetry exceeds that of real faces; the scan may be merged from two people"
        evidence = (
            f"{found.upper_mm:.1f} mm in the upper part, {found.middle_mm:.1f} mm in the middle, "
            f"{found.step_mm:.1f} mm beside the midline"
        )
        yield PlanStep.doubt("fit.asymmetry", reason, evidence)
    # Where covers were left out, the proportions are half the model's own.
    measured = fitted.landmarks is not None and fitted.metrics["covered_mm2"] == 0
    if fitted.landmarks is not None and measured and (ratios := proportions(fitted.landmarks).doubt()):
        reason = (
            "proportions are outside the range of the people measured (n = 9, and 164 synthetic ones); the "
            "scan may be stretched along an axis"
        )
        yield PlanStep.doubt("fit.proportions", reason, f"relative to the model's: {ratios}")


def face_coverage(fitted: FittedFace) -> float:
    """Return the part of the face's area that has scan near it.

    Of a template of a whole head only what is annotated counts: ears, neck and the back of the head are no
    part of the face.
    """
    model = fitted.model
    rest = [model.regions[name].index for name in (REST_REGION, FILLED_REGION) if name in model.regions]
    counted = ~np.isin(fitted.region, rest)
    if model.template_points is None or not counted.any():
        return fitted.metrics["coverage"]
    area = face_areas(fitted.vertices, fitted.faces) * counted
    seen = (~np.isnan(fitted.residual_mm))[fitted.faces].mean(1)
    return float(area @ seen / max(area.sum(), 1e-300))


def missing_parts(fitted: FittedFace) -> tuple[str, ...]:
    """Return the names of the face's parts (`PARTS`) that have no scan near; none without landmarks."""
    landmarks = fitted.model.landmarks
    if landmarks is None:
        return ()
    rest = fitted.model.surface(fitted.levels)[0]
    skin = ~_in_regions(fitted.model, fitted.levels, MOUTH_REGION)
    area = vertex_areas(fitted.vertices, fitted.faces) * skin
    seen = ~np.isnan(fitted.residual_mm)

    def covered(numbers: tuple[int, ...], radius_mm: float) -> float:
        near = np.linalg.norm(rest - landmarks[list(numbers)].mean(0), axis=1) < radius_mm
        return float(area[near & seen].sum() / max(area[near].sum(), 1e-300))

    return tuple(name for name, part in PARTS.items() if covered(*part) < LEAST_OF_A_PART)


@dataclass(frozen=True)
class Asymmetry:
    """How the halves of a face differ, mm: RMS over patches of the mean distance to the mirror image.

    `upper_mm` of the upper face, which expressions hardly move; `middle_mm` from the brows to the chin, which
    hair hardly covers; `step_mm` beside the midline; 0 where too little is seen. `noise_mm` is the mean
    distance of the fit to the scan.
    """

    upper_mm: float
    middle_mm: float
    step_mm: float
    noise_mm: float

    @property
    def unlikeness(self) -> float:
        """How unlike the halves are in units of what is told: of both parts of the face, or of the step."""
        noise_mm = max(self.noise_mm - CLEAN_MM, 0.0)
        both_mm = min(self.upper_mm, self.middle_mm)
        step_mm = self.step_mm if both_mm > 0 else 0.0
        return max(both_mm / (UNLIKE_MM + 2 * noise_mm), step_mm / (UNLIKE_MM + 4 * noise_mm))


def asymmetry(fitted: FittedFace) -> Asymmetry | None:
    """Return how the halves of a fitted face differ; None where the model or the scan do not show it.

    The face is laid on its mirror image by the vertices of the upper face that have scan near on both sides;
    distances are measured along the normals. Only models that are their own mirror image are judged.
    """
    model, landmarks = fitted.model, fitted.model.landmarks
    level = min(LEVEL, fitted.levels)
    rest = model.surface(level)[0]
    mirror = np.array([-1.0, 1.0, 1.0])
    gap, twin = cKDTree(rest).query(rest * mirror)
    if landmarks is None or gap.max() > MIRROR_TOLERANCE_MM:
        return None
    # Those of a coarser refinement come first.
    points, faces = fitted.vertices[: len(rest)], model.subdivision(level).faces
    seen = ~np.isnan(fitted.residual_mm[: len(rest)])
    seen &= seen[twin] & ~_in_regions(model, level, MOUTH_REGION)
    area = vertex_areas(points, faces)
    side, height = np.abs(rest[:, 0]), rest[:, 1] - landmarks[27, 1]
    upper = height > UPPER_ABOVE_MM
    if not (area * (seen & upper)).any():
        return None
    distance = _mirror_distance_mm(points, vertex_normals(points, faces), twin, area * (seen & upper))
    middle = _between(height, MIDDLE_MM) & (side < HALF_WIDTH_MM)
    nose = _in_regions(model, level, "nose", "left_nostril", "right_nostril")
    strip = _between(height, MIDLINE_HEIGHT_MM) & _between(side, MIDLINE_MM) & ~nose
    left = rest[:, 0] > 0

    def unlike_mm(where: BoolArray, patch_mm: float) -> float:
        half = where & left
        cell = np.floor(np.column_stack([side, height])[half] / patch_mm).astype(np.int64)
        return _rms_over_patches(cell, distance[half], area[half], seen[half])

    return Asymmetry(
        unlike_mm(upper, UPPER_PATCH_MM),
        unlike_mm(middle, MIDDLE_PATCH_MM),
        unlike_mm(strip, UPPER_PATCH_MM),
        fitted.metrics["residual_mean_mm"],
    )


def _mirror_distance_mm(
    points: FloatArray, normals: FloatArray, twin: IntArray, weight: FloatArray
) -> FloatArray:
    """Return (V,) the distance of a face's mirror image along its normals, laid on it robustly."""
    image, robust = points[twin] * [-1.0, 1.0, 1.0], np.ones(len(points))
    for _ in range(ITERATIONS):
        laid = transform_points(procrustes(image, points, weights=weight * robust), image)
        distance = np.einsum("ij,ij->i", laid - points, normals)
        robust = 1 / (1 + (distance / ROBUST_MM) ** 2)
    return distance


def _rms_over_patches(cell: IntArray, distance: FloatArray, area: FloatArray, seen: BoolArray) -> float:
    """Return the RMS of the patches' means, weighted by their seen area; 0 where too few are seen."""
    patch = np.unique(cell, axis=0, return_inverse=True)[1].ravel()
    known = np.bincount(patch, area * seen)
    mean = np.bincount(patch, area * seen * distance) / np.maximum(known, 1e-300)
    used = known > LEAST_OF_A_PATCH * np.bincount(patch, area)
    if known[used].sum() < LEAST_OF_A_REGION * area.sum():
        return 0.0
    return float(np.sqrt(known[used] @ mean[used] ** 2 / known[used].sum()))


def _between(values: FloatArray, ends: tuple[float, float]) -> BoolArray:
    return np.asarray((values > ends[0]) & (values < ends[1]))


def _in_regions(model: AnnotatedSurface, level: int, *names: str) -> BoolArray:
    """Return (V,) which vertices of a refinement touch the regions."""
    subdivision = model.subdivision(level)
    faces = np.logical_or.reduce([model.in_region(name) for name in names])[subdivision.parent]
    inside = np.zeros(subdivision.matrix.shape[0], bool)
    inside[subdivision.faces[faces].ravel()] = True
    return inside
