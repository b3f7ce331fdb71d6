"""Candidate poses: refined by robust ICP, scored, ranked, until one lays the model on a face."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from scan2albedo.core import Meter
from scan2albedo.core.arrays import FloatArray
from scan2albedo.geometry.rigid import Similarity, invert_rigid
from scan2albedo.registration.coarse_search import PlacedPose, Poses
from scan2albedo.registration.evidence import HOPELESS, ColourScorer, Evidence, evidence
from scan2albedo.registration.icp import FEW, icp, rigid_distance_mm, rms_mm
from scan2albedo.registration.inputs import PreparedScan, Template
from scan2albedo.registration.relief import ReliefAgreement

CONVINCING = 4.0
"""Log odds of a face (98 %) beyond which no other pose is refined."""
_MOST_LOG_ODDS = 8.0
"""No pose is surer than 0.9997, or less sure than 0.0003: no calibration set is larger."""
_ENOUGH_COVERAGE = 0.6
LEAST_RANKING = 0.15
"""Of poses that are looked at: of 60 faces captured badly, the least that was one had 0.17."""


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
        return self.likeness * float(np.sqrt(min(1.0, self.relief.coverage / _ENOUGH_COVERAGE)))

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
    best = candidates[0]
    if best.convinces or best.log_odds < HOPELESS or (colors := scorer()) is None:
        return candidates
    scored = list(candidates)
    for place, candidate in enumerate(scored):
        if candidate.evidence is not None and candidate.color_log_odds is None:
            pose = candidate.pose
            model_from_scan = invert_rigid(pose.rigid(front)) @ scan.prepared_from_scan
            scored[place] = replace(candidate, color_log_odds=colors(model_from_scan, pose.scale))
    return _sorted(scored)


class CandidateSearch:
    """Refines coarse poses on a scan, round by round, and ranks them.

    A pose that `landmarks` show comes before all; the `scorer`, which says how colours speak for a pose, is
    asked for only where the shape leaves doubts.
    """

    def __init__(
        self,
        scan: PreparedScan,
        template: Template,
        poses: Poses,
        count: int,
        meter: Meter,
        landmarks: PlacedPose | None = None,
        scorer: Callable[[], ColourScorer | None] = lambda: None,
    ) -> None:
        self.scan = scan
        self.template = template
        self.few = template.first(FEW)
        self.poses = poses
        self.count = count
        self.meter = meter
        self.landmarks = landmarks
        self.scorer = scorer

    def until_convinced(self) -> Candidates:
        """Return the candidates, best first, after as many rounds as it takes until one is a face."""
        candidates = Candidates()
        for poses in self.rounds():
            candidates = self._looked_at(self._refined(poses, candidates))
            candidates = rescored(candidates, self.scan, self.template.front, self.scorer)
            if self.meter.exhausted or candidates[0].convinces:
                break
        return candidates

    def rounds(self) -> Iterator[Poses]:
        """Yield the poses that landmarks show, those nearest to the scan, and those with most relief.

        Relief is asked for because distance alone prefers the back of a head to half a face: of the nearest
        poses first, then of all, among which a face is that is much larger or smaller than the model's.
        """
        if self.landmarks is not None:
            yield self.landmarks.start()
        yield self.poses.subset(np.arange(len(self.poses))[: (self.count + 1) // 2])
        poses = map(Similarity, self.poses.rotations, self.poses.translations)
        relief = [Candidate(pose, self._agreement(pose), 0.0).ranking for pose in poses]
        ranked = np.argsort(-np.array(relief), kind="stable")
        yield self.poses.subset(ranked[ranked < 5 * self.count][: self.count])
        yield self.poses.subset(ranked[: 2 * self.count])

    def _agreement(self, pose: Similarity) -> ReliefAgreement:
        return self.template.image.agreement(self.scan.vertices, self.scan.faces, pose.inverse())

    def _refined(self, starts: Poses, known: Sequence[Candidate]) -> list[Candidate]:
        """Return the known candidates, and every start refined with the face's size.

        A start at a known candidate is dropped; one is refined however small the budget is.
        """
        samples, meter = self.scan.samples, self.meter
        candidates = list(known)
        for rotation, translation in zip(starts.rotations, starts.translations, strict=True):
            if candidates and meter.exhausted:
                break
            pose = Similarity(rotation, translation)
            if any(pose.is_near(other.pose, np.deg2rad(3), 3) for other in candidates):
                continue
            # From a scale of 6 mm to one of 3.
            pose = icp(samples, self.few, pose, np.geomspace(6, 3, 15)).pose
            candidates.append(Candidate(pose, self._agreement(pose), rms_mm(samples, self.few, pose)))
            meter.count()
            # The nearest pose so far.
            before = (row.error for row in meter.rows if row.stage == meter.stage)
            meter.record(min([rigid_distance_mm(samples, self.few, pose), *before]))
        return candidates

    def _looked_at(self, candidates: Sequence[Candidate]) -> Candidates:
        """Look at the first three candidates that are apart from each other, those seen before among them."""
        ranked = sorted(candidates, key=lambda candidate: -candidate.ranking)
        looked = list[Candidate]()
        for place, candidate in enumerate(ranked):
            if len(looked) == 3 or (looked and self.meter.exhausted):
                break
            if candidate.ranking < LEAST_RANKING and self.landmarks is None and not self.meter.exhausted:
                break
            if not all(candidate.is_apart(other) for other in looked):
                continue
            if candidate.evidence is None:
                found = evidence(self.scan, self.template, candidate.pose, self.meter)
                odds = 0.0 if self.landmarks is None else self.landmarks.log_odds(found.pose)
                candidate = replace(candidate, pose=found.pose, evidence=found, landmark_log_odds=odds)
                ranked[place] = candidate
            looked.append(candidate)
            if candidate.convinces:
                break
        return _sorted(ranked)


def _sorted(candidates: list[Candidate]) -> Candidates:
    return tuple(sorted(candidates, key=lambda candidate: (-candidate.log_odds, -candidate.ranking)))
