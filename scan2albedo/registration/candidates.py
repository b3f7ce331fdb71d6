"""Candidate poses: refined by Open3D's ICP and ours, scored, ranked, until one lays the model on a face."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from types import ModuleType

import numpy as np
from threadpoolctl import threadpool_limits

from scan2albedo.core import Meter
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.errors import import_open3d
from scan2albedo.face_model import AnnotatedSurface
from scan2albedo.geometry.oriented_points import OrientedPoints
from scan2albedo.geometry.rigid import Similarity, invert_rigid
from scan2albedo.registration.coarse_search import Poses
from scan2albedo.registration.evidence import Evidence, evidence
from scan2albedo.registration.options import RegistrationOptions
from scan2albedo.registration.placed_pose import PlacedPose
from scan2albedo.registration.relief import FaceScores, normal_relief
from scan2albedo.registration.robust_icp import residuals, rigid_distance_mm, robust_icp
from scan2albedo.registration.scan_preparation import PreparedScan
from scan2albedo.registration.template import Template
from scan2albedo.registration.texture_evidence import TextureWitness

_CONVINCING = 4.0
"""Log odds of a face (98 %) beyond which no further poses are refined."""
_CONVINCING_PERSON = 0.95
"""The same of its proportions."""
_MOST_LOG_ODDS = 8.0
"""No pose is surer than 0.9997, or less sure than 0.0003: no calibration set is larger."""
_MORE_CANDIDATES = 24
"""Further poses that are refined before a scan is refused."""
_LOOKED_AT = 3
"""Candidates of a batch whose evidence is looked at."""
_OTHER_ROTATION_RAD = np.deg2rad(20)
_OTHER_POSITION_MM = 30.0
_SAMPLES = 400
_RANKED_BY_RELIEF = 40
_SAME_ROTATION_RAD = np.deg2rad(3)
_SAME_POSITION_MM = 3.0


@dataclass(frozen=True)
class Candidate:
    """A refined pose on the prepared scan, its scores, and for the best few what speaks for a face there."""

    pose: Similarity
    scores: FaceScores
    evidence: Evidence | None = None
    color_log_odds: float | None = None
    """What the scan's colours say for this pose; None where they were not asked."""
    landmark_log_odds: float = 0.0
    """What landmarks that someone placed say for it."""

    @property
    def log_odds(self) -> float:
        """Of a face at this pose; -inf where it was not looked at."""
        if self.evidence is None:
            return -np.inf
        odds = self.evidence.log_odds + (self.color_log_odds or 0.0) + self.landmark_log_odds
        return float(np.clip(odds, -_MOST_LOG_ODDS, _MOST_LOG_ODDS))

    @property
    def person(self) -> float:
        """Probability that a face at this pose has a person's proportions, whatever its colours say."""
        return 1.0 if self.evidence is None else self.evidence.person

    @property
    def convinces(self) -> bool:
        """Whether it is so surely a person's face that nothing else is looked for."""
        return self.log_odds > _CONVINCING and self.person > _CONVINCING_PERSON

    def is_apart(self, other: Candidate) -> bool:
        """Whether the poses are clearly not the same."""
        return not self.pose.is_near(other.pose, _OTHER_ROTATION_RAD, _OTHER_POSITION_MM)


@dataclass(frozen=True)
class Colors:
    """The colours of a scan, which are asked only where its shape leaves doubts."""

    scan: PreparedScan
    model: AnnotatedSurface

    @cached_property
    def _witness(self) -> TextureWitness | None:
        return TextureWitness.of(self.scan.raw, self.model)

    def heard(self, candidates: tuple[Candidate, ...]) -> tuple[Candidate, ...]:
        """Return the candidates, those that were looked at with what the colours say; the best first."""
        if candidates[0].convinces or self._witness is None:
            return candidates
        heard = list(candidates)
        for place, candidate in enumerate(heard):
            if candidate.evidence is not None and candidate.color_log_odds is None:
                pose = candidate.pose
                model_from_scan = invert_rigid(pose.rigid(self.model.front)) @ self.scan.prepared_from_scan
                said = self._witness.evidence(model_from_scan, pose.scale)
                heard[place] = replace(candidate, color_log_odds=0.0 if said is None else said.log_odds)
        return tuple(sorted(heard, key=lambda c: (-c.log_odds, -c.scores.ranking)))


def ranked_candidates(
    scan: PreparedScan,
    template: Template,
    colors: Colors,
    landmarks: PlacedPose | None,
    poses: Poses,
    options: RegistrationOptions,
    meter: Meter,
) -> tuple[Candidate, ...]:
    """Refine and rank candidates, batch by batch, until one is a face; best first.

    The pose that landmarks show comes before all. After every batch the best of all so far are looked at
    closely (`Evidence`), and the scan's colours heard when none is clearly a face.
    """
    target = ScanTarget(scan.samples)
    candidates: tuple[Candidate, ...] = ()
    placed = () if landmarks is None else (landmarks.start(),)
    for batch in chain(placed, _batches(scan, template, poses, options.candidates, _MORE_CANDIDATES)):
        candidates = _with_refined(scan, target, template, batch, options, meter, candidates)
        candidates = colors.heard(_with_evidence(scan, template, candidates, meter, landmarks))
        if meter.exhausted or candidates[0].convinces:
            return candidates
    # Open3D's wide pairs draw half a face round the head, towards its missing half: refine without it.
    for batch in _batches(scan, template, poses, 2 * options.candidates, 0):
        candidates = _with_refined(scan, None, template, batch, options, meter, candidates)
        candidates = colors.heard(_with_evidence(scan, template, candidates, meter, landmarks))
        if meter.exhausted or candidates[0].convinces:
            return candidates
    return candidates


def every_candidate(
    scan: PreparedScan, template: Template, poses: Poses, options: RegistrationOptions, meter: Meter
) -> tuple[Candidate, ...]:
    """Refine and rank `options.candidates` poses, faces or not; best first."""
    target = ScanTarget(scan.samples)
    candidates: tuple[Candidate, ...] = ()
    for batch in _batches(scan, template, poses, options.candidates, 0):
        candidates = _with_refined(scan, target, template, batch, options, meter, candidates)
    return _with_evidence(scan, template, candidates, meter)


def _with_evidence(
    scan: PreparedScan,
    template: Template,
    candidates: tuple[Candidate, ...],
    meter: Meter,
    landmarks: PlacedPose | None = None,
) -> tuple[Candidate, ...]:
    """Look at the first `_LOOKED_AT` candidates that are apart from each other, those seen before among them.

    The answer is sorted by the odds, then by the ranking.
    """
    ranked = sorted(candidates, key=lambda c: -c.scores.ranking)
    looked = list[Candidate]()
    for place, candidate in enumerate(ranked):
        if len(looked) == _LOOKED_AT or (looked and meter.exhausted):
            break
        if not all(candidate.is_apart(other) for other in looked):
            continue
        if candidate.evidence is None:
            found = evidence(scan, template, candidate.pose, meter)
            said = 0.0 if landmarks is None else landmarks.log_odds(found.pose)
            candidate = replace(candidate, pose=found.pose, evidence=found, landmark_log_odds=said)
            ranked[place] = candidate
        looked.append(candidate)
        if candidate.convinces:
            break
    return tuple(sorted(ranked, key=lambda c: (-c.log_odds, -c.scores.ranking)))


def _batches(
    scan: PreparedScan, template: Template, poses: Poses, candidates: int, more_candidates: int
) -> Iterator[Poses]:
    """Yield `candidates` poses in two batches, then `more_candidates` in a third.

    First those whose surface is nearest, then those with most relief among the nearer ones, at last those
    with most relief among all: distance alone prefers the whole back of a head to half a face, and relief
    alone is expensive.
    """
    model = template.first(_SAMPLES)

    def by_relief(count: int) -> IntArray:
        """Return the first `count` poses in the order of the relief that the scan's normals show there."""
        relief = [
            normal_relief(scan.grid, model, poses.rotations[i], poses.translations[i]) for i in range(count)
        ]
        return np.argsort(-np.array(relief), kind="stable")

    first = np.arange(min((candidates + 1) // 2, len(poses)))
    yield poses.subset(first)
    nearer = by_relief(min(_RANKED_BY_RELIEF, len(poses)))
    second = nearer[~np.isin(nearer, first)][: candidates - len(first)]
    yield poses.subset(second)
    every = by_relief(len(poses))
    rest = every[~np.isin(every, np.concatenate([first, second]))]
    yield poses.subset(rest[:more_candidates])


def _with_refined(
    scan: PreparedScan,
    target: ScanTarget | None,
    template: Template,
    starts: Poses,
    options: RegistrationOptions,
    meter: Meter,
    known: tuple[Candidate, ...],
) -> tuple[Candidate, ...]:
    """Refine every start by Open3D's ICP, then with scale, and rank them with the `known`, best first.

    Without a `target` Open3D's part is left out. A start that ends at a known candidate is dropped.
    At least one is refined however small the budget is.
    """
    samples = template.first(_SAMPLES)
    poses = [candidate.pose for candidate in known]
    candidates = list(known)
    for rotation, translation in zip(starts.rotations, starts.translations, strict=True):
        if candidates and meter.exhausted:
            break
        pose = Similarity(rotation, translation)
        if target is not None:
            refined = target.refine(
                samples, pose.rigid(), max_distance_mm=20.0, scale_mm=8.0, iterations=options.icp_iterations
            )
            pose = Similarity(refined[:3, :3], refined[:3, 3])
            meter.count()
        if any(pose.is_near(other, _SAME_ROTATION_RAD, _SAME_POSITION_MM) for other in poses):
            continue
        poses.append(pose)
        candidates.append(_scored(scan, template, samples, pose, options.scaled_iterations))
        meter.count()
        best = max(candidates, key=lambda c: c.scores.ranking)
        meter.record(rigid_distance_mm(scan.samples, template, best.pose))
    return tuple(sorted(candidates, key=lambda c: -c.scores.ranking))


def _scored(
    scan: PreparedScan, template: Template, samples: OrientedPoints, start: Similarity, iterations: int
) -> Candidate:
    """Refine pose and size, and score the result."""
    pose = robust_icp(scan.samples, samples, samples.areas, start, iterations=iterations, sigma_mm=(6.0, 3.0))
    rms_mm = residuals(scan.samples, samples, pose).trimmed_rms_mm(samples.areas)
    scores = template.image.scores(scan.vertices, scan.faces, pose.inverse(), rms_mm)
    return Candidate(pose, scores)


class ScanTarget:
    """Scan samples (mm) prepared for many ICP runs."""

    def __init__(self, samples: OrientedPoints) -> None:
        self._open3d = import_open3d()
        self._cloud = self._cloud_of(samples)

    def _cloud_of(self, samples: OrientedPoints):  # type: ignore[no-untyped-def]
        geometry, utility = self._open3d.geometry, self._open3d.utility
        cloud = geometry.PointCloud(utility.Vector3dVector(samples.points))
        cloud.normals = utility.Vector3dVector(samples.normals)
        return cloud

    def refine(
        self,
        model: OrientedPoints,
        scan_from_model: FloatArray,
        *,
        max_distance_mm: float,
        scale_mm: float,
        iterations: int,
    ) -> FloatArray:
        """Return the (4, 4) `scan_from_model` after point-to-plane ICP of the model with Tukey's loss.

        `max_distance_mm` is the greatest distance of a pair, `scale_mm` Tukey's constant: pairs farther apart
        along the normal have no weight. Runs on one thread: Open3D adds up its normal equations in the order
        the threads finish, so more threads would give other bits each time.
        """
        registration = self._open3d.pipelines.registration
        with _one_thread(self._open3d):
            result = registration.registration_icp(
                self._cloud_of(model),
                self._cloud,
                max_distance_mm,
                scan_from_model,
                registration.TransformationEstimationPointToPlane(registration.TukeyLoss(k=scale_mm)),
                registration.ICPConvergenceCriteria(1e-6, 1e-6, iterations),
            )
        return np.array(result.transformation)


@contextmanager
def _one_thread(open3d: ModuleType) -> Iterator[None]:
    """Keep Open3D on one thread: from 0.20 on through its own setting (TBB), before that through OpenMP's."""
    if not hasattr(open3d.utility, "set_max_threads"):
        with threadpool_limits(1, "openmp"):
            yield
        return
    threads = open3d.utility.get_max_threads()
    open3d.utility.set_max_threads(1)
    try:
        yield
    finally:
        open3d.utility.set_max_threads(threads)
