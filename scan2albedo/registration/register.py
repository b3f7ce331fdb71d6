"""Rigid registration: find the face in a raw scan, in any pose, without landmarks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scan2albedo.errors import RegistrationError
from scan2albedo.face_model.model import AnnotatedFaceModel
from scan2albedo.geometry.rigid import invert_rigid
from scan2albedo.io.raw_scan import RawScan
from scan2albedo.optimization import Budget, Meter, ProgressCallback
from scan2albedo.registration.candidates import (
    Candidate,
    ScanView,
    judged_candidates,
    runner_up_score,
)
from scan2albedo.registration.coarse_search import CoarsePoses, coarse_poses
from scan2albedo.registration.finish import annealed, rms_mm, tightened
from scan2albedo.registration.open3d_icp import ScanTarget
from scan2albedo.registration.options import RegistrationOptions
from scan2albedo.registration.oriented_points import OrientedPoints, oriented_points
from scan2albedo.registration.own_frame import in_own_frame
from scan2albedo.registration.result import Registration
from scan2albedo.registration.robust_icp import ScanTree, residuals
from scan2albedo.registration.template import Template

FloatArray = NDArray[np.float64]

_FEWEST_VERTICES = 50
_FEWEST_SAMPLES = 150
_CONVINCING = 0.1
_NEAR_MM = 10.0


def register(
    scan: RawScan,
    model: AnnotatedFaceModel,
    budget: Budget | float | None = None,
    seed: int = 0,
    *,
    options: RegistrationOptions = RegistrationOptions(),
    on_progress: ProgressCallback | None = None,
) -> Registration:
    """Find the rigid pose of a scan's face in the model's frame.

    Thousands of starts on a voxel grid, the best of them refined by Open3D's robust point-to-plane
    ICP, then by one that also estimates the face's size; the pose whose depth image has the relief of
    a face wins, is tightened on the rigid regions, and annealed on depth derivatives [1]_; the annealed
    pose counts only when the surface distance is no worse for it.

    Parameters
    ----------
    scan : RawScan
        Any pose, mm; hair, shoulders, holes and loose pieces are welcome.
    model : AnnotatedFaceModel
    budget : Budget or seconds, optional
        When it ends the best pose so far is returned with ``converged=False``.
    seed : int
        Same seed, scan and budget in evaluations: same bits.
    options : RegistrationOptions
    on_progress : callable, optional
        Called with every trace row.

    Returns
    -------
    Registration

    Raises
    ------
    RegistrationError
        When the scan is too small to judge or holds no face; the message carries the figures.
    MissingDependencyError
        When Open3D cannot be loaded.

    References
    ----------
    .. [1] G. Toderici et al., "An automated method for human face modeling and relighting with
       application to face recognition", section 3.1.1.
    """
    meter = Meter("icp", "mm", Budget.of(budget), on_progress)
    vertices, own_from_scan = in_own_frame(scan.vertices, scan.faces)
    cloud = _samples_of(scan, vertices, options)
    template = Template.of(model, options.model_spacing_mm, seed)
    poses = coarse_poses(cloud, template, options, meter, seed)
    view = ScanView(vertices, scan.faces, ScanTree.of(cloud))
    candidates = _judged(scan, view, template, poses, options, meter)
    _refuse_facing_away(scan, view, template, candidates[0])
    closing = meter.child("tight_icp", "mm")
    tight = tightened(view, template, candidates[0].pose, closing)
    annealing = closing.child("depth_annealing", "truncated slope difference")
    final = annealed(view, template, tight, options, annealing, seed)
    return Registration(
        model_from_scan=invert_rigid(final.pose.rigid()) @ own_from_scan,
        rmse_mm=rms_mm(view, template, final.pose),
        depth_error=final.depth_error,
        converged=not any(m.exhausted for m in (meter, closing, annealing)),
        confidence=_confidence(candidates, options),
        iterations=meter.evaluations + closing.evaluations + annealing.evaluations,
        trace=meter.trace + closing.trace + annealing.trace,
        notes=(_search_note(candidates, len(poses), options), final.note),
        face_scale=final.pose.scale,
    )


def _samples_of(scan: RawScan, vertices: FloatArray, options: RegistrationOptions) -> OrientedPoints:
    if len(vertices) < _FEWEST_VERTICES:
        raise RegistrationError(
            f"{scan.name}: {len(vertices)} vertices cannot show a face, at least "
            f"{_FEWEST_VERTICES} are needed; scan the whole face"
        )
    cloud = oriented_points(vertices, scan.faces, options.scan_spacing_mm)
    if len(cloud) < _FEWEST_SAMPLES:
        raise RegistrationError(
            f"{scan.name}: its surface of {cloud.areas.sum():.0f} mm2 (box {_box_text(vertices)}) is too "
            "small for a face; check the unit of the file"
        )
    return cloud


def _box_text(vertices: FloatArray) -> str:
    return " x ".join(f"{side:.0f}" for side in np.ptp(vertices, axis=0)) + " mm"


def _judged(
    scan: RawScan,
    view: ScanView,
    template: Template,
    poses: CoarsePoses,
    options: RegistrationOptions,
    meter: Meter,
) -> tuple[Candidate, ...]:
    """Refine and rank candidates, look by look, until one is a face; refuse the scan if none is."""
    target = ScanTarget(view.tree.samples)
    candidates: tuple[Candidate, ...] = ()
    needed = options.certainty_needed + _CONVINCING
    for starts in poses.looks(options.candidates, options.more_candidates):
        candidates = judged_candidates(view, target, template, starts, meter, candidates)
        if meter.exhausted or _is_face(candidates[0], options, needed):
            return candidates
        needed = options.certainty_needed
    # Open3D's wide pairs draw half a face round the head, towards its missing half: look without it.
    for starts in poses.looks(2 * options.candidates, 0):
        candidates = judged_candidates(view, None, template, starts, meter, candidates)
        if meter.exhausted or _is_face(candidates[0], options, needed):
            return candidates
    _refuse_inside_out(scan, view, template, options, meter)
    _refuse_no_face(scan, candidates, options)
    return candidates


def _is_face(candidate: Candidate, options: RegistrationOptions, needed: float) -> bool:
    return candidate.evidence.coverage >= options.coverage_needed and candidate.evidence.certainty >= needed


def _refuse_inside_out(
    scan: RawScan, view: ScanView, template: Template, options: RegistrationOptions, meter: Meter
) -> None:
    """Tell a face whose triangles all face inward: fitting and shading would go wrong with it."""
    samples = view.tree.samples
    reversed_samples = OrientedPoints(samples.points, -samples.normals, samples.areas)
    reversed_view = ScanView(view.vertices, view.faces, ScanTree(reversed_samples, view.tree.tree))
    poses = coarse_poses(reversed_samples, template, options, meter, 0)
    target = ScanTarget(reversed_samples)
    candidates: tuple[Candidate, ...] = ()
    for starts in poses.looks(options.candidates, 0):
        candidates = judged_candidates(reversed_view, target, template, starts, meter, candidates)
    best = candidates[0]
    if _is_face(best, options, options.certainty_needed):
        raise RegistrationError(_inside_out_text(scan, best))


def _refuse_facing_away(scan: RawScan, view: ScanView, template: Template, best: Candidate) -> None:
    """Depth images show both sides of a surface: see that the normals agree as well."""
    measured = residuals(view.tree, template.samples, best.pose)
    near = measured.distance_mm < _NEAR_MM
    if near.any() and np.mean(measured.agreement[near] < 0) > 0.5:
        raise RegistrationError(_inside_out_text(scan, best))


def _inside_out_text(scan: RawScan, best: Candidate) -> str:
    return (
        f"{scan.name}: the scan is inside out: with its {len(scan.faces)} triangles reversed there is a "
        f"face (certainty {best.evidence.certainty:.2f}). Reverse the order of every triangle's "
        "vertices (scan.faces[:, ::-1]) and try again"
    )


def _refuse_no_face(scan: RawScan, candidates: tuple[Candidate, ...], options: RegistrationOptions) -> None:
    if _is_face(candidates[0], options, options.certainty_needed):
        return
    evidence = candidates[0].evidence
    raise RegistrationError(
        f"{scan.name}: no face found. The best of {len(candidates)} poses covers "
        f"{100 * evidence.coverage:.0f} % of the face (needed: {100 * options.coverage_needed:.0f} %) "
        f"with a certainty of {evidence.certainty:.2f} (needed: {options.certainty_needed:.2f}; "
        f"relief correlation {evidence.relief_correlation:.2f}, symmetry {evidence.symmetry:.2f}, "
        f"{evidence.rms_mm:.1f} mm RMS); "
        f"the scan's box is {_box_text(scan.vertices)}. "
        "Give a scan of a face, or process it without a model"
    )


def _confidence(candidates: tuple[Candidate, ...], options: RegistrationOptions) -> float:
    """Return how far the evidence lies above the refusal line and above any other pose, 0 ... 1."""
    best = candidates[0].evidence
    clear = (best.certainty - options.certainty_needed) / 0.1 + 0.3
    alone = (best.score - runner_up_score(candidates)) / 0.15
    return float(np.clip(min(clear, alone), 0, 1))


def _search_note(
    candidates: tuple[Candidate, ...], kept: int, options: RegistrationOptions
) -> tuple[str, bool, str, str]:
    best = candidates[0]
    return (
        "search",
        True,
        "the pose whose depth image has the relief of a face is taken",
        f"{len(candidates)} of {kept} candidates refined; "
        f"certainty {best.evidence.certainty:.2f} (needed: {options.certainty_needed:.2f}), "
        f"likeness {best.evidence.likeness:.2f} "
        f"(next pose {runner_up_score(candidates):.2f}), coverage {100 * best.evidence.coverage:.0f} %, "
        f"face {100 * best.pose.scale:.0f} % of the model's size",
    )
