"""Whether the best candidate is accepted as a face: refusals with their figures, and warnings of doubts."""

from __future__ import annotations

import warnings

import numpy as np

from scan2albedo.core import Meter
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.errors import RegistrationError
from scan2albedo.geometry.mesh import turned_against_neighbours
from scan2albedo.registration.candidates import (
    CERTAINTY_NEEDED,
    COVERAGE_NEEDED,
    Candidate,
    batches,
    with_refined,
)
from scan2albedo.registration.coarse_search import coarse_poses
from scan2albedo.registration.open3d_icp import ScanTarget
from scan2albedo.registration.options import RegistrationOptions
from scan2albedo.registration.oriented_points import OrientedPoints
from scan2albedo.registration.robust_icp import residuals
from scan2albedo.registration.scan_preparation import PreparedScan, box_text
from scan2albedo.registration.template import Template

_BEYOND_DOUBT = 0.62
_CLEARLY_OUTWARD = 0.12
_NEAR_MM = 10.0
_MIXED_SHARE = 0.02
_HUMAN_SCALE = (0.75, 1.3)
_OTHER_FACE_MM = 100.0


def refuse_inside_out(
    scan: PreparedScan, template: Template, best: Candidate, options: RegistrationOptions, meter: Meter
) -> None:
    """Refuse a face whose triangles all face inward: fitting and shading would go wrong with it.

    Such a face seen from behind has just enough relief to be taken for one; with the triangles
    reversed it has far more. So the reversed scan is searched where the best pose leaves doubt and the
    surface does not clearly bulge outward.
    """
    certain = best.scores.certainty >= _BEYOND_DOUBT
    if certain or (best.is_face() and _bulge(scan.samples) >= _CLEARLY_OUTWARD):
        return
    turned = scan.inside_out()
    # The turned scan is another problem than the scan, so its rows stay out of the trace.
    unseen = meter.untraced()
    poses = coarse_poses(turned.samples, template, options, unseen, 0)
    target = ScanTarget(turned.samples)
    candidates: tuple[Candidate, ...] = ()
    for batch in batches(poses, template, options.candidates, 0):
        candidates = with_refined(turned, target, template, batch, options, unseen, candidates)
    meter.count(unseen.evaluations)
    other = candidates[0]
    if other.scores.certainty > best.scores.certainty and other.is_face():
        raise RegistrationError(_inside_out_text(scan.raw, other))


def _bulge(samples: OrientedPoints) -> float:
    """Return sum a n.(p - c) / sum a |p - c| about the centroid c: -1 ... 1, its sign flips with the normals.

    Whole faces with hair and shoulders have 0.24 and more, half a face with them about 0.
    """
    offset = samples.points - samples.areas @ samples.points / samples.areas.sum()
    outward = np.einsum("ij,ij->i", offset, samples.normals)
    reach = samples.areas @ np.linalg.norm(offset, axis=1)
    return float(samples.areas @ outward / reach) if reach > 0 else 0.0


def refuse_facing_away(scan: PreparedScan, template: Template, best: Candidate) -> None:
    """Depth images show both sides of a surface: see that the normals agree as well."""
    measured = residuals(scan.samples, template.samples, best.pose)
    near = measured.distance_mm < _NEAR_MM
    if near.any() and np.mean(measured.agreement[near] < 0) > 0.5:
        raise RegistrationError(_inside_out_text(scan.raw, best))


def _inside_out_text(scan: RawScan, best: Candidate) -> str:
    turned = int(turned_against_neighbours(scan.faces).sum())
    if turned > _MIXED_SHARE * len(scan.faces):
        return (
            f"{scan.name}: {turned} of {len(scan.faces)} triangles are wound against their neighbours, so "
            "that the face is inside out in part. Reverse the order of their vertices (load_scan does it; "
            "scan2albedo.geometry.mesh.turned_against_neighbours names them) and try again"
        )
    return (
        f"{scan.name}: the scan is inside out: with its {len(scan.faces)} triangles reversed there is a "
        f"face (certainty {best.scores.certainty:.2f}). Reverse the order of every triangle's "
        "vertices (scan.faces[:, ::-1]) and try again"
    )


def refuse_no_face(scan: RawScan, candidates: tuple[Candidate, ...]) -> None:
    """Refuse, with the figures, a scan whose best candidate is no face."""
    if candidates[0].is_face():
        return
    scores = candidates[0].scores
    raise RegistrationError(
        f"{scan.name}: no face found. The best of {len(candidates)} poses covers "
        f"{100 * scores.coverage:.0f} % of the face (needed: {100 * COVERAGE_NEEDED:.0f} %) "
        f"with a certainty of {scores.certainty:.2f} (needed: {CERTAINTY_NEEDED:.2f}; "
        f"relief correlation {scores.relief_correlation:.2f}, symmetry {scores.symmetry:.2f}, "
        f"{scores.rms_mm:.1f} mm RMS); "
        f"the scan's box is {box_text(scan.vertices)}. "
        "Give a scan of a face in its true size (check the unit), or process it without a model"
    )


def warn_of_doubts(scan: RawScan, candidates: tuple[Candidate, ...], scale: float) -> None:
    """Warn of a size that no person's face has, and of a second face."""
    low, high = _HUMAN_SCALE
    if not low <= scale <= high:
        warnings.warn(
            f"{scan.name}: the face is {100 * scale:.0f} % of the model's size, which no person's is; check "
            "the unit of the scan",
            UserWarning,
            stacklevel=3,
        )
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
            stacklevel=3,
        )
