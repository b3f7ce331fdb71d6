"""The last steps at the chosen pose: tight ICP, annealing, and the check that decides between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2albedo.core import Meter
from scan2albedo.geometry.rigid import rotation_angle_rad
from scan2albedo.registration.candidates import ScanView, rigid_distance_mm
from scan2albedo.registration.depth_annealing import AnnealedPose, anneal_depth_derivatives
from scan2albedo.registration.options import RegistrationOptions
from scan2albedo.registration.robust_icp import SimilarPose, residuals, robust_icp, settled_icp
from scan2albedo.registration.template import Template

_CHECK_SIGMAS_MM = (0.5, 2.0)
_FIRST_ROUND_MM = (3.0, 2.0)
_FIRST_STEPS, _NARROWING_STEPS = 8, 4
_RIGID_PART = 0.3
_NOISE_MM, _SIGMAS_ABOVE_NOISE = 0.25, 6.0
_HARDLY_MOVING = 0.02
_TIGHTEST_MM, _WIDEST_MM = 0.35, 3.0

_SETTLED = "nothing to gain: ICP settled on a fixed point"
_UNSETTLED = "no gain measured where ICP keeps moving either; force it to compare"

Note = tuple[str, bool, str, str]


@dataclass(frozen=True)
class Annealed:
    """The pose after annealing (or before, when that was better), its objective and the note for the plan."""

    pose: SimilarPose
    depth_error: float | None
    note: Note


@dataclass(frozen=True)
class Tightened:
    """The pose of the tight ICP, the scale of its weights, and its last step (degrees or mm)."""

    pose: SimilarPose
    sigma_mm: float
    last_step: float

    @property
    def settled(self) -> bool:
        """Whether ICP ended on a fixed point."""
        return self.last_step < _HARDLY_MOVING


def tightened(
    view: ScanView, template: Template, start: SimilarPose, options: RegistrationOptions, meter: Meter
) -> Tightened:
    """Finish on all samples, weighted to the rigid regions; records the loss at the last scale.

    The last scale follows the surface: where nearly a third of the face lies within the noise (the
    model is the same person's), the rest is expression and must not pull; between people nothing
    fits that closely, and a wide scale has one optimum where a narrow one has many.
    """
    if meter.exhausted:
        return Tightened(start, _WIDEST_MM, float("inf"))
    return _settled(view, template, start, options, meter)


def _settled(
    view: ScanView, template: Template, start: SimilarPose, options: RegistrationOptions, meter: Meter
) -> Tightened:
    samples, weights = template.samples, template.rigidity
    pose = robust_icp(view.tree, samples, weights, start, iterations=_FIRST_STEPS, sigma_mm=_FIRST_ROUND_MM)
    near_mm = residuals(view.tree, samples, pose).quantile_mm(weights, _RIGID_PART)
    sigma_mm = float(np.clip(_SIGMAS_ABOVE_NOISE * (near_mm - _NOISE_MM), _TIGHTEST_MM, _WIDEST_MM))
    meter.count(_FIRST_STEPS)
    meter.record(residuals(view.tree, samples, pose).icp_loss_mm(weights, sigma_mm))
    pose = robust_icp(
        view.tree,
        samples,
        weights,
        pose,
        iterations=_NARROWING_STEPS,
        sigma_mm=(_FIRST_ROUND_MM[1], sigma_mm),
    )
    pose, steps, last = settled_icp(
        view.tree, samples, weights, pose, sigma_mm=sigma_mm, iterations=options.settling_iterations
    )
    meter.count(_NARROWING_STEPS + steps)
    meter.record(residuals(view.tree, samples, pose).icp_loss_mm(weights, sigma_mm))
    return Tightened(pose, sigma_mm, last)


def rms_mm(view: ScanView, template: Template, pose: SimilarPose) -> float:
    """Return the RMS distance of the model's inlying samples to the scan's tangent planes."""
    return residuals(view.tree, template.samples, pose).trimmed_rms_mm(template.samples.areas)


def annealed(
    view: ScanView,
    template: Template,
    start: Tightened,
    options: RegistrationOptions,
    meter: Meter,
    seed: int,
) -> Annealed:
    """Anneal on depth derivatives when forced, finish, and keep the answer if the surface says so.

    Left out by default: where ICP settled on a fixed point, the tight ICP mostly comes back to it from where
    annealing ends; where ICP keeps moving (another person's face, an open jaw), annealing's optimum is biased
    by the ways in which a face's relief differs from the model's: as often nearer to the truth as not, and
    0.2 degrees farther in the mean over 81 scans (`tools/bench_registration.py`). Its answer counts only when
    the robust distance of the rigid regions falls at two scales.
    """
    if options.annealing_evaluations == 0:
        return Annealed(start.pose, None, ("depth_annealing", False, "switched off", "0 evaluations"))
    if meter.exhausted:
        return Annealed(start.pose, None, ("depth_annealing", False, "the budget had ended", ""))
    if not options.force_annealing:
        reason = _SETTLED if start.settled else _UNSETTLED
        evidence = f"last step of ICP {start.last_step:.2g} degrees or mm, scale {start.sigma_mm:.2f} mm"
        return Annealed(start.pose, None, ("depth_annealing", False, reason, evidence))
    found = anneal_depth_derivatives(
        view.vertices,
        view.faces,
        template,
        start.pose,
        size=options.annealing_size,
        evaluations=options.annealing_evaluations,
        seed=seed,
        meter=meter,
    )
    # The polish has another yardstick than the annealing, so its rows stay out of the trace.
    unseen = meter.unseen_child()
    polished = _settled(view, template, found.pose, options, unseen)
    meter.count(unseen.evaluations)
    before, after = (
        [rigid_distance_mm(view, template, p, sigma) for sigma in _CHECK_SIGMAS_MM]
        for p in (start.pose, polished.pose)
    )
    better = all(a < b for a, b in zip(after, before, strict=True))
    note = _annealing_note(better, found, start.pose, polished.pose, before, after, meter.evaluations)
    if better:
        return Annealed(polished.pose, found.error, note)
    return Annealed(start.pose, found.start_error, note)


def _annealing_note(
    better: bool,
    found: AnnealedPose,
    start: SimilarPose,
    polished: SimilarPose,
    before_mm: list[float],
    after_mm: list[float],
    evaluations: int,
) -> Note:
    angle_deg = np.rad2deg(rotation_angle_rad(polished.rotation @ start.rotation.T))
    shift_mm = float(np.linalg.norm(polished.translation - start.translation))
    distances = " and ".join(f"{b:.3f} -> {a:.3f}" for b, a in zip(before_mm, after_mm, strict=True))
    evidence = (
        f"robust distance {distances} mm, objective {found.start_error:.4f} -> "
        f"{found.error:.4f} in {evaluations} evaluations, {angle_deg:.2f} degrees and {shift_mm:.2f} mm away"
    )
    verdict = "taken: the surface distance is less" if better else "dropped: the surface is no nearer"
    return ("depth_annealing", True, f"its pose is {verdict}", evidence)
