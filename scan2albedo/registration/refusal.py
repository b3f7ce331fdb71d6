"""Why a scan is refused, or taken with doubts: its size, no face in it or two, a face inside out."""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core import Meter
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.errors import RegistrationError
from scan2albedo.geometry.mesh import turned_against_neighbours
from scan2albedo.registration.candidates import Candidate, ScanView, judged_candidates
from scan2albedo.registration.coarse_search import coarse_poses
from scan2albedo.registration.open3d_icp import ScanTarget
from scan2albedo.registration.options import RegistrationOptions
from scan2albedo.registration.oriented_points import OrientedPoints
from scan2albedo.registration.robust_icp import ScanTree, residuals
from scan2albedo.registration.template import Template

FloatArray = NDArray[np.float64]

_FEWEST_VERTICES = 50
_FEWEST_SAMPLES = 150
_FACE_MM = 200.0
_LARGEST_MM = 6000.0
_TRIM_PERCENT = 2.0
_BEYOND_DOUBT = 0.62
_CLEARLY_OUTWARD = 0.12
_NEAR_MM = 10.0
_MIXED_SHARE = 0.02
_HUMAN_SCALE = (0.75, 1.3)
_OTHER_FACE_MM = 100.0


def refuse_wrong_size(scan: RawScan) -> None:
    """Refuse what has too few vertices, or is larger than a room, before anything is computed on it.

    The outermost 2 % of the vertices at either end of each axis do not count.
    """
    if len(scan.vertices) < _FEWEST_VERTICES:
        raise RegistrationError(
            f"{scan.name}: {len(scan.vertices)} vertices cannot show a face, at least "
            f"{_FEWEST_VERTICES} are needed; scan the whole face"
        )
    low, high = np.percentile(scan.vertices, [_TRIM_PERCENT, 100 - _TRIM_PERCENT], axis=0)
    longest = float((high - low).max())
    if longest > _LARGEST_MM:
        raise RegistrationError(
            f"{scan.name}: the scan (box {_box_text(scan.vertices)}) is too large: a face is about "
            f"{_FACE_MM:.0f} mm, and it is looked for in at most {_LARGEST_MM / 1000:.0f} m. "
            + _unit_text(longest)
        )


def refuse_too_small(scan: RawScan, samples: OrientedPoints) -> None:
    """Refuse a surface that gives too few samples to judge."""
    if len(samples) >= _FEWEST_SAMPLES:
        return
    raise RegistrationError(
        f"{scan.name}: its surface of {samples.areas.sum():.3g} mm2 (box {_box_text(scan.vertices)}) is too "
        f"small for a face of about {_FACE_MM:.0f} mm. "
        + _unit_text(float(np.ptp(scan.vertices, axis=0).max()))
    )


def _unit_text(longest_mm: float) -> str:
    """Name the power of ten that brings a length nearest to a face's."""
    power = round(float(np.log10(_FACE_MM / longest_mm))) if longest_mm > 0 else 0
    if power == 0:
        return "Scan the whole face, and check the unit of the file"
    return (
        "Check the unit of the file: vertices are taken as millimetres "
        f"(multiplied by {10.0**power:g} it would have the size of a face)"
    )


def _box_text(vertices: FloatArray) -> str:
    return " x ".join(f"{side:.3g}" for side in np.ptp(vertices, axis=0)) + " mm"


def is_face(candidate: Candidate, options: RegistrationOptions, needed: float) -> bool:
    """Tell whether a pose covers enough of the face with at least the `needed` certainty."""
    return candidate.evidence.coverage >= options.coverage_needed and candidate.evidence.certainty >= needed


def refuse_inside_out(
    scan: RawScan,
    view: ScanView,
    template: Template,
    best: Candidate,
    options: RegistrationOptions,
    meter: Meter,
) -> None:
    """Refuse a face whose triangles all face inward: fitting and shading would go wrong with it.

    Such a face seen from behind has just enough relief to be taken for one; with the triangles
    reversed it has far more. So the reversed scan is searched where the best pose leaves doubt and the
    surface does not clearly bulge outward.
    """
    samples = view.tree.samples
    certain = best.evidence.certainty >= _BEYOND_DOUBT
    found = is_face(best, options, options.certainty_needed)
    if certain or (found and _bulge(samples) >= _CLEARLY_OUTWARD):
        return
    reversed_samples = OrientedPoints(samples.points, -samples.normals, samples.areas)
    reversed_view = ScanView(view.vertices, view.faces, ScanTree(reversed_samples, view.tree.tree))
    # The reversed scan is another yardstick, so its rows stay out of the trace.
    unseen = meter.unseen_child()
    poses = coarse_poses(reversed_samples, template, options, unseen, 0)
    target = ScanTarget(reversed_samples)
    candidates: tuple[Candidate, ...] = ()
    for starts in poses.looks(options.candidates, 0):
        candidates = judged_candidates(reversed_view, target, template, starts, options, unseen, candidates)
    meter.count(unseen.evaluations)
    other = candidates[0]
    if other.evidence.certainty > best.evidence.certainty and is_face(
        other, options, options.certainty_needed
    ):
        raise RegistrationError(_inside_out_text(scan, other))


def _bulge(samples: OrientedPoints) -> float:
    """Return sum a n.(p - c) / sum a |p - c| about the centroid c: -1 ... 1, its sign flips with the normals.

    Whole faces with hair and shoulders have 0.24 and more, half a face with them about 0.
    """
    offset = samples.points - samples.areas @ samples.points / samples.areas.sum()
    outward = np.einsum("ij,ij->i", offset, samples.normals)
    reach = samples.areas @ np.linalg.norm(offset, axis=1)
    return float(samples.areas @ outward / reach) if reach > 0 else 0.0


def refuse_facing_away(scan: RawScan, view: ScanView, template: Template, best: Candidate) -> None:
    """Depth images show both sides of a surface: see that the normals agree as well."""
    measured = residuals(view.tree, template.samples, best.pose)
    near = measured.distance_mm < _NEAR_MM
    if near.any() and np.mean(measured.agreement[near] < 0) > 0.5:
        raise RegistrationError(_inside_out_text(scan, best))


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
        f"face (certainty {best.evidence.certainty:.2f}). Reverse the order of every triangle's "
        "vertices (scan.faces[:, ::-1]) and try again"
    )


def refuse_no_face(scan: RawScan, candidates: tuple[Candidate, ...], options: RegistrationOptions) -> None:
    """Refuse, with the figures, a scan whose best candidate is no face."""
    if is_face(candidates[0], options, options.certainty_needed):
        return
    evidence = candidates[0].evidence
    raise RegistrationError(
        f"{scan.name}: no face found. The best of {len(candidates)} poses covers "
        f"{100 * evidence.coverage:.0f} % of the face (needed: {100 * options.coverage_needed:.0f} %) "
        f"with a certainty of {evidence.certainty:.2f} (needed: {options.certainty_needed:.2f}; "
        f"relief correlation {evidence.relief_correlation:.2f}, symmetry {evidence.symmetry:.2f}, "
        f"{evidence.rms_mm:.1f} mm RMS); "
        f"the scan's box is {_box_text(scan.vertices)}. "
        "Give a scan of a face in its true size (check the unit), or process it without a model"
    )


def warn_of_doubts(
    scan: RawScan, candidates: tuple[Candidate, ...], scale: float, options: RegistrationOptions
) -> None:
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
        if is_face(other, options, _BEYOND_DOUBT)
    ]
    if apart and max(apart) > _OTHER_FACE_MM:
        warnings.warn(
            f"{scan.name}: there is a second face {max(apart):.0f} mm away; the one that resembles the model "
            "more was taken: cut the other off to choose",
            UserWarning,
            stacklevel=3,
        )
