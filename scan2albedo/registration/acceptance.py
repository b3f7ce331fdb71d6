"""Whether the best candidate is accepted as a face: refusals with their figures, and warnings of doubts."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from scan2albedo.core import Meter
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.errors import InsideOutError, NoFaceError, RegistrationError
from scan2albedo.geometry.oriented_points import OrientedPoints
from scan2albedo.registration.candidates import (
    CERTAINTY_NEEDED,
    COVERAGE_NEEDED,
    Candidate,
    every_candidate,
)
from scan2albedo.registration.coarse_search import coarse_poses
from scan2albedo.registration.options import RegistrationOptions
from scan2albedo.registration.robust_icp import residuals
from scan2albedo.registration.scan_preparation import PreparedScan, box_text
from scan2albedo.registration.template import Template

_BEYOND_DOUBT = 0.62
"""Certainty that no surface but a face reaches, seen from in front."""
_CLEARLY_OUTWARD = 0.12
_NEAR_MM = 10.0
_MIXED_SHARE = 0.02
"""A greater share of triangles wound against their neighbours is the reason to name."""
_OTHER_FACE_MM = 100.0
_OTHER_ROTATION_RAD = np.deg2rad(20)
_OTHER_POSITION_MM = 30.0
_WHOLE_COVERAGE = 0.8
_DOUBT_OF_MISSING = 0.4


@dataclass(frozen=True)
class Acceptance:
    """How clearly the best candidate is a face, 0 ... 1, and the search's note for the plan."""

    confidence: float
    note: tuple[str, bool, str, str]


def accepted(
    scan: PreparedScan,
    template: Template,
    candidates: tuple[Candidate, ...],
    pose_count: int,
    options: RegistrationOptions,
    meter: Meter,
) -> Acceptance:
    """Accept the first candidate, of those of `pose_count` poses that were refined, or refuse the scan.

    Where the budget has ended the scores are not complete, so that they refuse nothing. Raises
    `RegistrationError` when there is no face, or it is inside out; warns when there is a second face.
    """
    if not meter.exhausted:
        _refuse_inside_out(scan, template, candidates[0], options, meter)
        _refuse_no_face(scan.raw, candidates)
    _refuse_facing_away(scan, template, candidates[0])
    _warn_of_second_face(scan.raw, candidates)
    best = candidates[0]
    likeness = f"likeness {best.scores.likeness:.2f} (next pose {_next_ranking(candidates):.2f})"
    evidence = (
        f"{len(candidates)} of {pose_count} candidates refined; certainty {best.scores.certainty:.2f} "
        f"(needed: {CERTAINTY_NEEDED:.2f}), {likeness}, coverage {100 * best.scores.coverage:.0f} %, "
        f"face {100 * best.pose.scale:.0f} % of the model's size"
    )
    if scan.stray_faces:
        evidence += f"; {scan.stray_faces} triangles that reach far away left out"
    reason = "the pose whose depth image has the relief of a face is taken"
    return Acceptance(_confidence(candidates), ("search", True, reason, evidence))


def _refuse_inside_out(
    scan: PreparedScan, template: Template, best: Candidate, options: RegistrationOptions, meter: Meter
) -> None:
    """Refuse a face whose triangles all face inward: fitting and shading would go wrong with it.

    Seen from behind, its relief is just enough to be accepted; with the triangles reversed it is far greater.
    So the reversed scan is searched where the best pose is in doubt and the surface does not bulge outward.
    """
    certain = best.scores.certainty >= _BEYOND_DOUBT
    if certain or (best.is_face() and _bulge(scan.samples) >= _CLEARLY_OUTWARD):
        return
    turned = scan.inside_out()
    # The turned scan is another problem than the scan, so its rows stay out of the trace.
    unseen = meter.untraced()
    poses = coarse_poses(turned, template, options, unseen, 0)
    other = every_candidate(turned, template, poses, options, unseen)[0]
    meter.count(unseen.evaluations)
    if other.scores.certainty > best.scores.certainty and other.is_face():
        raise _inside_out_error(scan, other)


def _bulge(samples: OrientedPoints) -> float:
    """Return sum a n.(p - c) / sum a |p - c| about the centroid c: -1 ... 1, its sign flips with the normals.

    Whole faces with hair and shoulders have 0.24 and more, half a face with them about 0.
    """
    offset = samples.points - samples.areas @ samples.points / samples.areas.sum()
    outward = np.einsum("ij,ij->i", offset, samples.normals)
    reach = samples.areas @ np.linalg.norm(offset, axis=1)
    return float(samples.areas @ outward / reach) if reach > 0 else 0.0


def _refuse_facing_away(scan: PreparedScan, template: Template, best: Candidate) -> None:
    """Refuse a pose whose normals disagree, which depth images do not show."""
    measured = residuals(scan.samples, template.samples, best.pose)
    near = measured.distance_mm < _NEAR_MM
    if near.any() and np.mean(measured.agreement[near] < 0) > 0.5:
        raise _inside_out_error(scan, best)


def _inside_out_error(scan: PreparedScan, best: Candidate) -> RegistrationError:
    name, count = scan.raw.name, len(scan.raw.faces)
    if scan.turned_faces > _MIXED_SHARE * count:
        return RegistrationError(
            f"{name}: {scan.turned_faces} of {count} triangles are wound against their neighbours, so "
            "that the face is inside out in part. Reverse the order of their vertices (load_scan does it; "
            "scan2albedo.geometry.mesh.turned_against_neighbours names them) and try again"
        )
    return InsideOutError(
        f"{name}: the scan is inside out: with its {count} triangles reversed there is a "
        f"face (certainty {best.scores.certainty:.2f}). Reverse the order of every triangle's "
        "vertices (scan.inside_out()) and try again; if the export was mirrored, so that left and right are "
        "swapped, mirror it back instead"
    )


def _refuse_no_face(scan: RawScan, candidates: tuple[Candidate, ...]) -> None:
    """Refuse, with the figures, a scan whose best candidate is no face."""
    if candidates[0].is_face():
        return
    scores = candidates[0].scores
    raise NoFaceError(
        f"{scan.name}: no face found. The best of {len(candidates)} poses covers "
        f"{100 * scores.coverage:.0f} % of the face (needed: {100 * COVERAGE_NEEDED:.0f} %) "
        f"with a certainty of {scores.certainty:.2f} (needed: {CERTAINTY_NEEDED:.2f}; "
        f"relief correlation {scores.relief_correlation:.2f}, symmetry {scores.symmetry:.2f}, "
        f"{scores.rms_mm:.1f} mm RMS); "
        f"the scan's box is {box_text(scan.vertices)}. "
        "Give a scan of a face in its true size (check the unit), or process it without a model"
    )


def _warn_of_second_face(scan: RawScan, candidates: tuple[Candidate, ...]) -> None:
    best = candidates[0].pose.translation
    apart = [
        float(np.linalg.norm(other.pose.translation - best))
        for other in candidates[1:]
        if other.is_face(_BEYOND_DOUBT)
    ]
    if apart and max(apart) > _OTHER_FACE_MM:
        warnings.warn(
            f"{scan.name}: there is a second face {max(apart):.0f} mm away; the one that resembles the model "
            "more was taken: cut the other off to choose",
            UserWarning,
            stacklevel=4,
        )


def _next_ranking(candidates: tuple[Candidate, ...]) -> float:
    """Return the ranking of the best candidate whose pose clearly differs from the first's, or 0."""
    best = candidates[0].pose
    others = [
        c.scores.ranking
        for c in candidates[1:]
        if not c.pose.is_near(best, _OTHER_ROTATION_RAD, _OTHER_POSITION_MM)
    ]
    return max([0.0, *others])


def _confidence(candidates: tuple[Candidate, ...]) -> float:
    """Return the margin of the scores over the threshold for refusal and over any other pose's, 0 ... 1.

    Where part of the face is missing the threshold is higher: half a face that resembles the model little
    slides along it by a centimetre.
    """
    best = candidates[0].scores
    missing = max(0.0, _WHOLE_COVERAGE - best.coverage)
    clear = (best.certainty - CERTAINTY_NEEDED - _DOUBT_OF_MISSING * missing) / 0.1 + 0.3
    alone = (best.ranking - _next_ranking(candidates)) / 0.15
    return float(np.clip(min(clear, alone), 0, 1))
