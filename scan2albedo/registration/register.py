"""Rigid registration: find the face in a raw scan, in any pose, without landmarks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core import Budget, Meter, ProgressCallback, checked_seed
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.face_model.model import AnnotatedFaceModel
from scan2albedo.geometry.rigid import invert_rigid
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
from scan2albedo.registration.oriented_points import oriented_points
from scan2albedo.registration.own_frame import in_own_frame
from scan2albedo.registration.refusal import (
    is_face,
    refuse_facing_away,
    refuse_inside_out,
    refuse_no_face,
    refuse_too_small,
    refuse_wrong_size,
    warn_of_doubts,
)
from scan2albedo.registration.result import Registration
from scan2albedo.registration.robust_icp import ScanTree
from scan2albedo.registration.stray_vertices import without_stray
from scan2albedo.registration.template import Template

FloatArray = NDArray[np.float64]

_CONVINCING = 0.1
_WHOLE_COVERAGE = 0.8
_DOUBT_OF_MISSING = 0.4


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
    a face wins and is tightened on the rigid regions. The annealing on depth derivatives of [1]_ runs when
    forced (`RegistrationOptions.force_annealing`), and counts when the surface is nearer for it.

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

    Warns
    -----
    UserWarning
        When the face has a size that no person's has, or the scan holds a second face.

    Raises
    ------
    RegistrationError
        When the scan is too small to judge or holds no face; the message carries the figures.
    ValueError
        When `seed` is no whole number of 0 or more.
    MissingDependencyError
        When Open3D cannot be loaded.

    References
    ----------
    .. [1] G. Toderici et al., "An automated method for human face modeling and relighting with
       application to face recognition", section 3.1.1.
    """
    meter = Meter("icp", "mm", Budget.of(budget), on_progress)
    seed = checked_seed(seed)
    refuse_wrong_size(scan)
    faces = without_stray(scan.vertices, scan.faces)
    vertices, own_from_scan = in_own_frame(scan.vertices, faces)
    cloud = oriented_points(vertices, faces, options.scan_spacing_mm)
    refuse_too_small(scan, cloud)
    template = Template.of(model, options.model_spacing_mm, seed)
    poses = coarse_poses(cloud, template, options, meter, seed)
    view = ScanView(vertices, faces, ScanTree.of(cloud))
    candidates = _judged(view, template, poses, options, meter)
    if not meter.exhausted:
        refuse_inside_out(scan, view, template, candidates[0], options, meter)
        refuse_no_face(scan, candidates, options)
    refuse_facing_away(scan, view, template, candidates[0])
    closing = meter.child("tight_icp", "mm")
    tight = tightened(view, template, candidates[0].pose, options, closing)
    annealing = closing.child("depth_annealing", "truncated slope difference")
    final = annealed(view, template, tight, options, annealing, seed)
    warn_of_doubts(scan, candidates, final.pose.scale, options)
    return Registration(
        model_from_scan=invert_rigid(final.pose.rigid()) @ own_from_scan,
        rmse_mm=rms_mm(view, template, final.pose),
        depth_error=final.depth_error,
        converged=not any(m.exhausted for m in (meter, closing, annealing)),
        confidence=_confidence(candidates, options),
        iterations=meter.evaluations + closing.evaluations + annealing.evaluations,
        trace=meter.trace + closing.trace + annealing.trace,
        notes=(
            _search_note(candidates, len(poses), len(scan.faces) - len(faces), options),
            final.note,
        ),
        face_scale=final.pose.scale,
    )


def _judged(
    view: ScanView,
    template: Template,
    poses: CoarsePoses,
    options: RegistrationOptions,
    meter: Meter,
) -> tuple[Candidate, ...]:
    """Refine and rank candidates, look by look, until one is a face."""
    target = ScanTarget(view.tree.samples)
    candidates: tuple[Candidate, ...] = ()
    needed = options.certainty_needed + _CONVINCING
    for starts in poses.looks(options.candidates, options.more_candidates):
        candidates = judged_candidates(view, target, template, starts, options, meter, candidates)
        if meter.exhausted or is_face(candidates[0], options, needed):
            return candidates
        needed = options.certainty_needed
    # Open3D's wide pairs draw half a face round the head, towards its missing half: look without it.
    for starts in poses.looks(2 * options.candidates, 0):
        candidates = judged_candidates(view, None, template, starts, options, meter, candidates)
        if meter.exhausted or is_face(candidates[0], options, needed):
            return candidates
    return candidates


def _confidence(candidates: tuple[Candidate, ...], options: RegistrationOptions) -> float:
    """Return how far the evidence lies above the refusal line and above any other pose, 0 ... 1.

    Where part of the face is missing the line is higher: half a face that resembles the model little
    slides along it by a centimetre.
    """
    best = candidates[0].evidence
    missing = max(0.0, _WHOLE_COVERAGE - best.coverage)
    clear = (best.certainty - options.certainty_needed - _DOUBT_OF_MISSING * missing) / 0.1 + 0.3
    alone = (best.score - runner_up_score(candidates)) / 0.15
    return float(np.clip(min(clear, alone), 0, 1))


def _search_note(
    candidates: tuple[Candidate, ...], kept: int, stray: int, options: RegistrationOptions
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
        f"face {100 * best.pose.scale:.0f} % of the model's size"
        + (f"; {stray} triangles that reach far away left out" if stray else ""),
    )
