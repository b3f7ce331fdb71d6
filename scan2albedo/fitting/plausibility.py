"""What a scan of one whole person does not show: parts without scan, halves that are unlike or copied.

Thresholds lie above what 324 fits to faces gave, of 164 synthetic and nine measured people.
"""

from collections.abc import Iterator

import numpy as np
from scipy.spatial import cKDTree

from scan2albedo.core import PlanStep
from scan2albedo.core.arrays import SMALLEST, BoolArray, Texts, dots, norms
from scan2albedo.face_model import AnnotatedSurface
from scan2albedo.face_model.annotation import MOUTH_REGION
from scan2albedo.fitting.result import FittedFace
from scan2albedo.geometry.mesh import face_areas, vertex_areas, vertex_mask, vertex_normals
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

UNLIKE_MM = 1.3
"""Differences of the halves, and steps at the midline, beyond those of real faces: they reach 0.9 of it."""
CLEAN_MM = 0.15
"""Where the fit is farther from the scan than this in the mean, noise and hair add to these."""
HALF_WIDTH_MM = 66.0
"""Of the middle of the face."""
LEAST_OF_A_PATCH = 0.4
"""Part of a patch's area that must be seen on both sides."""
LEAST_OF_A_REGION = 0.6
"""Part of the area of a region that such patches must show."""
SYMMETRIC_MM = 0.02
"""Median distance of a scan to its mirror image, below which one half is a copy of the other: of eleven
scanned people it is 0.18 and more, of modelled heads, whose makers mirrored much of them, 0.05 and more."""
MIRROR_TOLERANCE_MM = 0.1
"""Farthest a vertex of a mirror-symmetric model is from its twin."""


def doubts(fitted: FittedFace) -> Iterator[PlanStep]:
    """Yield a row for each thing about a fitted face that scans of one whole person do not have."""
    if missing := missing_parts(fitted):
        names = " and ".join(filter(None, (", ".join(missing[:-1]), missing[-1])))
        reason = f"no scan near the {names} (a hole, glasses, a beard?): the shape there is the model's own"
        yield PlanStep.doubt("fit.missing", reason)
    found = asymmetry(fitted)
    if found is not None and found[0] > 1:
        reason = "asymmetry exceeds that of real faces; the scan may be merged from two people"
        yield PlanStep.doubt("fit.asymmetry", reason, found[1])
    if fitted.mirror_mm < SYMMETRIC_MM:
        reason = "one half of the scan may be a copy of the other: no face is so nearly its own mirror image"
        evidence = f"{fitted.metrics['mirror_mm']:.3f} mm from it, scanned faces 0.18 mm and more"
        yield PlanStep.doubt("fit.symmetry", reason, evidence)


def face_coverage(fitted: FittedFace) -> float:
    """Return the part of the face with scan near it; of a whole head only what is annotated counts."""
    counted = fitted.model.face_regions()[fitted.region]
    if counted.all():
        return fitted.coverage
    area = face_areas(fitted.vertices, fitted.faces) * counted
    return float(area @ (~np.isnan(fitted.residual_mm))[fitted.faces].mean(1) / max(area.sum(), SMALLEST))


def missing_parts(fitted: FittedFace) -> Texts:
    """Return the names of the face's parts (`PARTS`) that have no scan near; none without landmarks."""
    landmarks = fitted.model.landmarks
    if landmarks is None:
        return ()
    rest = fitted.model.surface(fitted.levels)[0]
    skin = ~_in_regions(fitted.model, fitted.levels, MOUTH_REGION)
    area = vertex_areas(fitted.vertices, fitted.faces) * skin
    seen = ~np.isnan(fitted.residual_mm)

    def covered(numbers: tuple[int, ...], radius_mm: float) -> float:
        near = norms(rest - landmarks[list(numbers)].mean(0)) < radius_mm
        return float(area[near & seen].sum() / max(area[near].sum(), SMALLEST))

    return tuple(name for name, part in PARTS.items() if covered(*part) < LEAST_OF_A_PART)


def asymmetry(fitted: FittedFace) -> tuple[float, str] | None:
    """Return how the halves of a face differ, 1 for the most of real faces, and the evidence.

    None where the model or the scan do not show it. The face is laid on its mirror image by the vertices of
    the upper face that have scan near on both sides; distances are measured along the normals, averaged over
    patches. Only models that are their own mirror image are judged.
    """
    model, landmarks = fitted.model, fitted.model.landmarks
    level, mirror = min(1, fitted.levels), np.array([-1.0, 1.0, 1.0])
    rest = model.surface(level)[0]
    gap, twin = cKDTree(rest).query(rest * mirror)
    if landmarks is None or gap.max() > MIRROR_TOLERANCE_MM:
        return None
    # Those of a coarser refinement come first.
    points, faces = fitted.vertices[: len(rest)], model.subdivision(level).faces
    seen = ~np.isnan(fitted.residual_mm[: len(rest)])
    seen &= seen[twin] & ~_in_regions(model, level, MOUTH_REGION)
    area = vertex_areas(points, faces)
    side, height = np.abs(rest[:, 0]), rest[:, 1] - landmarks[27, 1]
    upper = height > -49.0  # mm above the nasion: expressions hardly move it
    if not (area * (seen & upper)).any():
        return None
    # The mirror image is laid on the face robustly: distances above 1 mm count less and less.
    image, normals = points[twin] * mirror, vertex_normals(points, faces)
    weight, robust = area * (seen & upper), np.ones(len(points))
    for _ in range(6):
        laid = transform_points(procrustes(image, points, weights=weight * robust), image)
        distance = dots(laid - points, normals)
        robust = 1 / (1 + distance**2)

    def unlike_mm(where: BoolArray, patch_mm: float) -> float:
        """RMS of the patches' means over the left half, weighted by seen area; 0 where too few are seen."""
        half = where & (rest[:, 0] > 0)
        cell = np.floor(np.column_stack([side, height])[half] / patch_mm).astype(int)
        patch = np.unique(cell, axis=0, return_inverse=True)[1].ravel()
        whole, shown = area[half], area[half] * seen[half]
        known = np.bincount(patch, shown)
        mean = np.bincount(patch, shown * distance[half]) / np.maximum(known, SMALLEST)
        used = known > LEAST_OF_A_PATCH * np.bincount(patch, whole)
        if known[used].sum() < LEAST_OF_A_REGION * whole.sum():
            return 0.0
        return float(np.sqrt(known[used] @ mean[used] ** 2 / known[used].sum()))

    nose = _in_regions(model, level, "nose", "left_nostril", "right_nostril")
    # Hair hardly covers the middle; neither lips nor hair move the strip beside the midline of the brows.
    middle = (height > -94) & (height < 26) & (side < HALF_WIDTH_MM)
    strip = (height > -10) & (height < 32) & (side > 2) & (side < 12) & ~nose
    # Differences are averaged over patches, against noise.
    upper_mm, middle_mm = unlike_mm(upper, 22.0), unlike_mm(middle, 26.0)
    both_mm, step_mm = min(upper_mm, middle_mm), unlike_mm(strip, 22.0)
    noise_mm = max(float(np.nanmean(fitted.residual_mm)) - CLEAN_MM, 0.0)
    step = step_mm / (UNLIKE_MM + 4 * noise_mm) if both_mm > 0 else 0.0
    parts = f"{upper_mm:.1f} mm in the upper part, {middle_mm:.1f} mm in the middle"
    excess = max(both_mm / (UNLIKE_MM + 2 * noise_mm), step)
    return excess, f"{parts}, {step_mm:.1f} mm beside the midline"


def _in_regions(model: AnnotatedSurface, level: int, *names: str) -> BoolArray:
    """Return (V,) which vertices of a refinement touch the regions."""
    subdivision = model.subdivision(level)
    faces = np.logical_or.reduce([model.in_region(name) for name in names])[subdivision.parent]
    return vertex_mask(subdivision.matrix.shape[0], subdivision.faces[faces])
