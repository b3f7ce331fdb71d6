"""The last steps at the chosen pose: tight ICP, annealing, and the check that decides between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2albedo.geometry.rigid import rotation_angle_rad
from scan2albedo.optimization import Meter
from scan2albedo.registration.candidates import ScanView, rigid_distance_mm
from scan2albedo.registration.depth_annealing import AnnealedPose, anneal_depth_derivatives
from scan2albedo.registration.options import RegistrationOptions
from scan2albedo.registration.robust_icp import SimilarPose, residuals, robust_icp
from scan2albedo.registration.template import Template

_CHECK_SIGMA_MM = 2.0

Note = tuple[str, bool, str, str]


@dataclass(frozen=True)
class Annealed:
    """The pose after annealing (or before, when that was better), its objective and the note for the plan."""

    pose: SimilarPose
    depth_error: float | None
    note: Note


def tightened(view: ScanView, template: Template, start: SimilarPose, meter: Meter) -> SimilarPose:
    """Finish on all samples, weighted to the rigid regions; records their robust distance."""
    pose = start
    if not meter.exhausted:
        pose = _polished(view, template, start, (3.0, 1.0), 20)
        meter.count(20)
    meter.record(rigid_distance_mm(view, template, pose))
    return pose


def rms_mm(view: ScanView, template: Template, pose: SimilarPose) -> float:
    """Return the RMS distance of the model's inlying samples to the scan's tangent planes."""
    return residuals(view.tree, template.samples, pose).trimmed_rms_mm(template.samples.areas)


def annealed(
    view: ScanView,
    template: Template,
    start: SimilarPose,
    options: RegistrationOptions,
    meter: Meter,
    seed: int,
) -> Annealed:
    """Anneal on depth derivatives, polish, and keep the answer only if the surface distance says so.

    The derivatives' optimum is biased where a face's relief differs from the model's, so its answer
    counts only when the robust distance of the rigid regions is no worse for it.
    """
    if options.annealing_evaluations == 0:
        return Annealed(start, None, ("depth_annealing", False, "switched off", "0 evaluations"))
    if meter.exhausted:
        return Annealed(start, None, ("depth_annealing", False, "the budget had ended", ""))
    found = anneal_depth_derivatives(
        view.vertices,
        view.faces,
        template,
        start,
        size=options.annealing_size,
        evaluations=options.annealing_evaluations,
        seed=seed,
        meter=meter,
    )
    polished = _polished(view, template, found.pose, (2.0, 1.0), 10)
    before, after = (rigid_distance_mm(view, template, p, _CHECK_SIGMA_MM) for p in (start, polished))
    taken = options.force_annealing or after <= before
    note = _annealing_note(found, start, polished, before, after, meter.evaluations)
    if taken:
        return Annealed(polished, found.error, note)
    return Annealed(start, found.start_error, note)


def _polished(
    view: ScanView,
    template: Template,
    start: SimilarPose,
    sigma_mm: tuple[float, float],
    iterations: int,
) -> SimilarPose:
    return robust_icp(
        view.tree, template.samples, template.rigidity, start, iterations=iterations, sigma_mm=sigma_mm
    )


def _annealing_note(
    found: AnnealedPose,
    start: SimilarPose,
    polished: SimilarPose,
    before_mm: float,
    after_mm: float,
    evaluations: int,
) -> Note:
    angle_deg = np.rad2deg(rotation_angle_rad(polished.rotation @ start.rotation.T))
    shift_mm = float(np.linalg.norm(polished.translation - start.translation))
    reason = (
        "its pose is taken: the surface distance is no worse"
        if after_mm <= before_mm
        else "its pose is dropped: the surface distance is worse"
    )
    evidence = (
        f"robust distance {before_mm:.3f} -> {after_mm:.3f} mm, objective {found.start_error:.4f} -> "
        f"{found.error:.4f} in {evaluations} evaluations, {angle_deg:.2f} degrees and {shift_mm:.2f} mm away"
    )
    return ("depth_annealing", True, reason, evidence)
