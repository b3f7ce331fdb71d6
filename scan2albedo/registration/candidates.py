"""Refine candidate poses and judge which of them lays the model on a face."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core import Meter
from scan2albedo.geometry.rigid import rotation_angle_rad
from scan2albedo.registration.face_evidence import FaceEvidence
from scan2albedo.registration.open3d_icp import ScanTarget
from scan2albedo.registration.options import RegistrationOptions
from scan2albedo.registration.oriented_points import OrientedPoints
from scan2albedo.registration.robust_icp import ScanTree, SimilarPose, residuals, robust_icp
from scan2albedo.registration.starts import Starts
from scan2albedo.registration.template import Template

FloatArray = NDArray[np.float64]

_SAMPLES = 400
_TRACE_SIGMA_MM = 1.0
_SAME_ROTATION_RAD = np.deg2rad(3)
_SAME_POSITION_MM = 3.0
_OTHER_ROTATION_RAD = np.deg2rad(20)
_OTHER_POSITION_MM = 30.0


@dataclass(frozen=True)
class Candidate:
    """A refined pose (scan frame centred) and the evidence for it."""

    pose: SimilarPose
    evidence: FaceEvidence


@dataclass(frozen=True)
class ScanView:
    """The scan, centred, as the candidates are judged on it."""

    vertices: FloatArray
    faces: NDArray[np.int64]
    tree: ScanTree


def judged_candidates(
    scan: ScanView,
    target: ScanTarget | None,
    template: Template,
    starts: Starts,
    options: RegistrationOptions,
    meter: Meter,
    before: tuple[Candidate, ...] = (),
) -> tuple[Candidate, ...]:
    """Refine every start by Open3D's ICP, then with scale, and rank by face evidence, best first.

    Without a `target` Open3D's part is left out. Candidates judged `before` are ranked with the new ones;
    a start that ends at one of them is left.
    At least one is refined however small the budget is.
    """
    samples = template.first(_SAMPLES)
    poses = [candidate.pose for candidate in before]
    candidates = list(before)
    for rotation, translation in zip(starts.rotations, starts.translations, strict=True):
        if candidates and meter.exhausted:
            break
        pose = SimilarPose(rotation, translation)
        if target is not None:
            pose = _widely_refined(target, samples, pose, options.icp_iterations)
            meter.count()
        if any(_near(pose, other, _SAME_ROTATION_RAD, _SAME_POSITION_MM) for other in poses):
            continue
        poses.append(pose)
        candidates.append(_judged(scan, template, pose, options.scaled_iterations))
        meter.count()
        best = max(candidates, key=lambda c: c.evidence.score)
        meter.record(rigid_distance_mm(scan, template, best.pose))
    return tuple(sorted(candidates, key=lambda c: -c.evidence.score))


def _widely_refined(
    target: ScanTarget, samples: OrientedPoints, start: SimilarPose, iterations: int
) -> SimilarPose:
    refined = target.refine(samples, start.rigid(), max_distance_mm=20.0, scale_mm=8.0, iterations=iterations)
    return SimilarPose(refined[:3, :3], refined[:3, 3])


def _judged(scan: ScanView, template: Template, start: SimilarPose, iterations: int) -> Candidate:
    samples = template.first(_SAMPLES)
    pose = robust_icp(scan.tree, samples, samples.areas, start, iterations=iterations, sigma_mm=(6.0, 3.0))
    rms_mm = residuals(scan.tree, samples, pose).trimmed_rms_mm(samples.areas)
    evidence = template.image.evidence(scan.vertices, scan.faces, pose.model_from_scan(), rms_mm)
    return Candidate(pose, evidence)


def rigid_distance_mm(
    view: ScanView, template: Template, pose: SimilarPose, sigma_mm: float = _TRACE_SIGMA_MM
) -> float:
    """Return the robust distance of the model's samples to the scan, weighted to the rigid regions."""
    return residuals(view.tree, template.samples, pose).robust_cost(template.rigidity, sigma_mm)


def runner_up_score(candidates: tuple[Candidate, ...]) -> float:
    """Return the score of the best candidate whose pose clearly differs from the first's, or 0."""
    best = candidates[0].pose
    others = [
        c.evidence.score
        for c in candidates[1:]
        if not _near(c.pose, best, _OTHER_ROTATION_RAD, _OTHER_POSITION_MM)
    ]
    return max([0.0, *others])


def _near(a: SimilarPose, b: SimilarPose, angle_rad: float, distance_mm: float) -> bool:
    return (
        float(np.linalg.norm(a.translation - b.translation)) < distance_mm
        and rotation_angle_rad(a.rotation @ b.rotation.T) < angle_rad
    )
