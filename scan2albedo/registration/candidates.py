"""Candidate poses: refined by Open3D's ICP and ours, scored, ranked, until one lays the model on a face."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cache
from itertools import chain, repeat

import numpy as np
from threadpoolctl import threadpool_limits

from scan2albedo.core import Meter
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.errors import import_open3d
from scan2albedo.geometry.oriented_points import OrientedPoints
from scan2albedo.geometry.rigid import Similarity, invert_rigid
from scan2albedo.registration.coarse_search import PlacedPose, Poses
from scan2albedo.registration.evidence import ColourScorer, Evidence, evidence
from scan2albedo.registration.icp import FEW, icp, residuals, rigid_distance_mm
from scan2albedo.registration.inputs import PreparedScan, RegistrationOptions, Template
from scan2albedo.registration.relief import ReliefAgreement

CONVINCING = 4.0
"""Log odds of a face (98 %) beyond which no other pose is refined."""
_MOST_LOG_ODDS = 8.0
"""No pose is surer than 0.9997, or less sure than 0.0003: no calibration set is larger."""
_ENOUGH_COVERAGE = 0.6


@dataclass(frozen=True)
class Candidate:
    """A refined pose on the prepared scan, how it looks, and for the best few the evidence of a face."""

    pose: Similarity
    relief: ReliefAgreement
    rms_mm: float
    """`relief` of the rigid template, and RMS distance of its inlying samples to the scan."""
    evidence: Evidence | None = None
    color_log_odds: float | None = None
    """What the scan's colours say for this pose; None where they were not asked."""
    landmark_log_odds: float = 0.0
    """What placed landmarks say for it."""

    @property
    def likeness(self) -> float:
        """Correlation of the relief times exp(-(rms / 7 mm)^2); 0.9 for the model itself."""
        return self.relief.local * float(np.exp(-((self.rms_mm / 7) ** 2)))

    @property
    def ranking(self) -> float:
        """Likeness, lessened where little of the face is covered: ranks poses."""
        return self.likeness * min(1.0, self.relief.coverage / _ENOUGH_COVERAGE) ** 0.5

    @property
    def log_odds(self) -> float:
        """Of a face at this pose; -inf where it was not looked at."""
        if self.evidence is None:
            return -np.inf
        odds = self.evidence.log_odds + (self.color_log_odds or 0.0) + self.landmark_log_odds
        return float(np.clip(odds, -_MOST_LOG_ODDS, _MOST_LOG_ODDS))

    @property
    def convinces(self) -> bool:
        """Whether it is so surely a face that nothing else is looked for."""
        return self.log_odds > CONVINCING

    def is_apart(self, other: Candidate) -> bool:
        """Whether the poses are clearly not the same: 20 degrees or 30 mm from each other."""
        return not self.pose.is_near(other.pose, np.deg2rad(20), 30)


Candidates = tuple[Candidate, ...]


def rescored(
    candidates: Candidates, scan: PreparedScan, front: FloatArray, scorer: Callable[[], ColourScorer | None]
) -> Candidates:
    """Return the candidates, those that were looked at with what the scan's colours say; the best first.

    `front` (3,) is the model's; the `scorer` is asked for only where the shape leaves doubts.
    """
    if candidates[0].convinces or (colors := scorer()) is None:
        return candidates
    scored = list(candidates)
    for place, candidate in enumerate(scored):
        if candidate.evidence is not None and candidate.color_log_odds is None:
            pose = candidate.pose
            model_from_scan = invert_rigid(pose.rigid(front)) @ scan.prepared_from_scan
            scored[place] = replace(candidate, color_log_odds=colors(model_from_scan, pose.scale))
    return _sorted(scored)


def ranked_candidates(
    scan: PreparedScan,
    template: Template,
    scorer: Callable[[], ColourScorer | None],
    landmarks: PlacedPose | None,
    poses: Poses,
    options: RegistrationOptions,
    meter: Meter,
) -> Candidates:
    """Refine and rank candidates, batch by batch, until one is a face; best first.

    The pose that landmarks show comes before all. After every batch the best of all so far are looked at
    closely (`Evidence`), and the scan's colours scored when none is clearly a face. Without landmarks the
    search ends after two batches of which nothing resembles a face at all.
    """
    candidates, relief = Candidates(), _reliefs(scan, template, poses)
    placed = () if landmarks is None else (landmarks.start(),)
    batches = chain(placed, _batches(poses, relief, options.candidates, 3 * options.candidates))
    # Open3D's wide pairs draw half a face round the head, towards its missing half: at last without it.
    freely = _batches(poses, relief, 2 * options.candidates, 0)
    every = chain(zip(batches, repeat(True)), zip(freely, repeat(False)))
    for number, (batch, widely) in enumerate(every):
        candidates = _with_refined(scan, template, batch, meter, candidates, widely=widely)
        candidates = _with_evidence(scan, template, candidates, meter, landmarks)
        candidates = rescored(candidates, scan, template.front, scorer)
        hopeless = number == 1 and landmarks is None and candidates[0].log_odds <= -_MOST_LOG_ODDS
        if meter.exhausted or candidates[0].convinces or hopeless:
            break
    return candidates


def every_candidate(
    scan: PreparedScan, template: Template, poses: Poses, options: RegistrationOptions, meter: Meter
) -> Candidates:
    """Refine and rank `options.candidates` poses, faces or not; best first."""
    candidates = Candidates()
    for batch in _batches(poses, _reliefs(scan, template, poses), options.candidates, 0):
        candidates = _with_refined(scan, template, batch, meter, candidates, widely=True)
    return _with_evidence(scan, template, candidates, meter, None)


def _sorted(candidates: list[Candidate]) -> Candidates:
    return tuple(sorted(candidates, key=lambda c: (-c.log_odds, -c.ranking)))


def _with_evidence(
    scan: PreparedScan, template: Template, candidates: Candidates, meter: Meter, landmarks: PlacedPose | None
) -> Candidates:
    """Look at the first three candidates that are apart from each other, those seen before among them.

    The answer is sorted by the odds, then by the ranking.
    """
    ranked = sorted(candidates, key=lambda c: -c.ranking)
    looked = list[Candidate]()
    for place, candidate in enumerate(ranked):
        if len(looked) == 3 or (looked and meter.exhausted):
            break
        if not all(candidate.is_apart(other) for other in looked):
            continue
        if candidate.evidence is None:
            found = evidence(scan, template, candidate.pose, meter)
            odds = 0.0 if landmarks is None else landmarks.log_odds(found.pose)
            candidate = replace(candidate, pose=found.pose, evidence=found, landmark_log_odds=odds)
            ranked[place] = candidate
        looked.append(candidate)
        if candidate.convinces:
            break
    return _sorted(ranked)


def _reliefs(scan: PreparedScan, template: Template, poses: Poses) -> Callable[[int], float]:
    """Return what ranks a pose by its relief, given its number; each is looked at once."""

    @cache
    def ranking(number: int) -> float:
        pose = Similarity(poses.rotations[number], poses.translations[number])
        relief = template.image.agreement(scan.vertices, scan.faces, pose.inverse())
        return Candidate(pose, relief, 0.0).ranking

    return ranking


def _batches(
    poses: Poses, relief: Callable[[int], float], candidates: int, more_candidates: int
) -> Iterator[Poses]:
    """Yield `candidates` poses in two batches, then `more_candidates` in a third.

    First those whose surface is nearest, then those with most `relief` among the nearer ones, at last among
    all: distance alone prefers the back of a head to half a face.
    """

    def by_relief(count: int) -> IntArray:
        return np.argsort([-relief(number) for number in range(min(count, len(poses)))], kind="stable")

    first = np.arange(min((candidates + 1) // 2, len(poses)))
    yield poses.subset(first)
    nearer = by_relief(5 * candidates)
    second = nearer[~np.isin(nearer, first)][: candidates - len(first)]
    yield poses.subset(second)
    if more_candidates:
        every = by_relief(len(poses))
        yield poses.subset(every[~np.isin(every, np.concatenate([first, second]))][:more_candidates])


def _with_refined(
    scan: PreparedScan, template: Template, starts: Poses, meter: Meter, known: Candidates, *, widely: bool
) -> Candidates:
    """Refine every start, `widely` by Open3D's ICP first, then with scale, and rank all.

    A start that ends at a known candidate is dropped; one is refined however small the budget is.
    """
    few = template.first(FEW)
    refined = [candidate.pose for candidate in known]
    candidates = list(known)
    for rotation, translation in zip(starts.rotations, starts.translations, strict=True):
        if candidates and meter.exhausted:
            break
        pose = Similarity(rotation, translation)
        if widely:
            matrix = refined_by_open3d(scan.samples, few.samples, pose.rigid())
            pose = Similarity(matrix[:3, :3], matrix[:3, 3])
            meter.count()
        if any(pose.is_near(other, np.deg2rad(3), 3) for other in refined):
            continue
        refined.append(pose)
        # With the face's size, from a scale of 6 mm to one of 3.
        pose = icp(scan.samples, few, pose, np.geomspace(6, 3, 15)).pose
        rms_mm = residuals(scan.samples, few.samples, pose).trimmed_rms_mm(few.samples.areas)
        relief = template.image.agreement(scan.vertices, scan.faces, pose.inverse())
        candidates.append(Candidate(pose, relief, rms_mm))
        meter.count()
        # The nearest pose so far.
        before = (row.error for row in meter.rows if row.stage == meter.stage)
        meter.record(min([rigid_distance_mm(scan.samples, template, pose), *before]))
    return tuple(sorted(candidates, key=lambda c: -c.ranking))


def refined_by_open3d(scan: OrientedPoints, model: OrientedPoints, scan_from_model: FloatArray) -> FloatArray:
    """Return the (4, 4) `scan_from_model` after point-to-plane ICP of the model's samples with Tukey's loss.

    On one thread: Open3D adds up its equations as threads finish, which would give other bits each time.
    """
    open3d = import_open3d()
    registration, utility, clouds = open3d.pipelines.registration, open3d.utility, []
    for samples in (model, scan):
        clouds.append(open3d.geometry.PointCloud(utility.Vector3dVector(samples.points)))
        clouds[-1].normals = utility.Vector3dVector(samples.normals)
    with ExitStack() as afterwards:
        # From 0.20 on by its own setting (TBB), before that by OpenMP's.
        if hasattr(utility, "set_max_threads"):
            afterwards.callback(utility.set_max_threads, utility.get_max_threads())
            utility.set_max_threads(1)
        else:
            afterwards.enter_context(threadpool_limits(1, "openmp"))
        result = registration.registration_icp(
            *clouds,
            20.0,  # mm
            scan_from_model,
            registration.TransformationEstimationPointToPlane(registration.TukeyLoss(k=8.0)),
            registration.ICPConvergenceCriteria(1e-6, 1e-6, 20),
        )
    return np.array(result.transformation)
