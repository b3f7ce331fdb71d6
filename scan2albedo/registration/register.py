"""Rigid registration: find the face in a raw scan, in any pose, without landmarks."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.special import expit, logit

from scan2albedo.core import (
    BudgetLike,
    Meter,
    OnProgress,
    Plan,
    PlanStep,
    RawScan,
    Trace,
    checked_seed,
)
from scan2albedo.core.arguments import require_type
from scan2albedo.core.arrays import FloatArray
from scan2albedo.errors import NoFaceError
from scan2albedo.face_model import AnnotatedSurface
from scan2albedo.geometry.rigid import Similarity, invert_rigid, rotation_angle_rad
from scan2albedo.registration.acceptance import (
    LEAST_PROBABILITY,
    accepted,
    probability,
    proportion_doubts,
    shape_of,
)
from scan2albedo.registration.candidates import CandidateSearch
from scan2albedo.registration.coarse_search import PlacedPose, coarse_poses
from scan2albedo.registration.depth_annealing import annealed
from scan2albedo.registration.evidence import colour_scorer
from scan2albedo.registration.icp import rms_mm, tightened
from scan2albedo.registration.inputs import RegistrationOptions, Template, box_text, prepared_scan


@dataclass(frozen=True)
class Registration:
    """Rigid pose of a scan in the model's frame."""

    model_from_scan: FloatArray
    """(4, 4): maps scan points (mm) into the model's frame."""
    rmse_mm: float
    """Root mean square distance model -> scan over the inliers at the final pose."""
    depth_error: float | None
    """Depth-derivative objective at the final pose; None when annealing did not run."""
    converged: bool
    """False when a budget ended the search."""
    confidence: float
    """0 ... 1: probability that this is the pose of a face (see `registration.register`)."""
    iterations: int
    """Objective evaluations and ICP iterations spent."""
    trace: Trace
    """Stages "icp", "shaped_icp" and "tight_icp" (mm), and "depth_annealing" (objective) when forced."""
    plan: Plan = Plan()
    """What the steps inside decided, and doubts about the result."""
    face_scale: float = 1.0
    """Size of the face relative to the model's; `model_from_scan` is rigid and does not contain it. A face of
    another size lies on the model at its `front`."""


def register(
    scan: RawScan,
    model: AnnotatedSurface,
    budget: BudgetLike = None,
    seed: int = 0,
    *,
    options: RegistrationOptions = RegistrationOptions(),
    on_progress: OnProgress = None,
) -> Registration:
    """Return the rigid pose of a scan's face in the model's frame.

    Thousands of starts on a voxel grid, the best refined by robust point-to-plane ICP with the face's size,
    then with a person's shape. The pose that is most probably that of a face wins, with that probability as
    `confidence`. The annealing of [1]_ runs when forced, and counts when the
    surface is nearer for it. `plan` doubts a second face, and proportions and sizes beyond those of faces.

    Raises RegistrationError, with the figures, when the scan is too small or too large, or holds no face;
    ValueError when `seed` is no whole number of 0 or more; TypeError for other objects than a scan, a model
    and options.

    .. [1] G. Toderici et al., "An automated method for human face modeling and relighting with
       application to face recognition", section 3.1.1.

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
    """
    require_type(scan, RawScan, "register: scan", "load_scan(path) returns one")
    require_type(model, AnnotatedSurface, "register: model", "AnnotatedFaceModel.default() returns one")
    require_type(options, RegistrationOptions, "register: options", "make them with RegistrationOptions()")
    meter = Meter("icp", "mm", budget, on_progress)
    seed = checked_seed(seed)
    prepared = prepared_scan(scan, options)
    template = Template.of(model, seed)
    poses = coarse_poses(prepared, template, options, meter, seed)
    scorer, landmarks = cache(lambda: colour_scorer(scan, model)), PlacedPose.of(prepared, model)
    search = CandidateSearch(prepared, template, poses, options.candidates, meter, landmarks, scorer)
    candidates = search.until_convinced()
    plan = accepted(prepared, template, candidates, len(poses), options, meter)
    closing = meter.sub_meter("tight_icp", "mm")
    best = candidates[0]
    tight, step = tightened(prepared.samples, template, best.pose, options.settling_iterations, closing)
    person = template
    if best.evidence is not None and not step.ran:
        person = template.in_shape(best.evidence.coefficients)
    annealing = closing.sub_meter("depth_annealing", "truncated slope difference")
    final = annealed(prepared, person, tight, options, annealing, seed)
    plan += (step, final.step)
    if best.evidence is not None and (shape := shape_of(prepared, model, best.evidence, seed)) is not None:
        plan += tuple(proportion_doubts(shape))
    return Registration(
        model_from_scan=invert_rigid(final.pose.rigid(model.front)) @ prepared.prepared_from_scan,
        rmse_mm=rms_mm(prepared.samples, template, final.pose),
        depth_error=final.error,
        converged=not any(m.exhausted for m in (meter, closing, annealing)),
        confidence=probability(candidates),
        iterations=meter.evaluations + closing.evaluations + annealing.evaluations,
        trace=meter.trace + closing.trace + annealing.trace,
        plan=plan,
        face_scale=final.pose.scale,
    )


def refined_registration(
    searched: Registration, scan: RawScan, model: AnnotatedSurface, model_from_scan: FloatArray, scale: float
) -> Registration:
    """Return the registration with a refined pose (4, 4) and face scale, the RMS distance measured there.

    The plan tells how far that pose is from the one before. All else, `depth_error` too, is the search's.
    """
    # In the frame of the search, so that the same pose has the same distance.
    prepared = prepared_scan(scan, RegistrationOptions())
    scan_from_model = prepared.prepared_from_scan @ invert_rigid(model_from_scan)
    pose = Similarity.of_rigid(scan_from_model, scale, model.front)
    change = model_from_scan @ invert_rigid(searched.model_from_scan)
    turned_deg = np.rad2deg(rotation_angle_rad(change[:3, :3]))
    evidence = f"{turned_deg:.1f} degrees and {np.linalg.norm(change[:3, 3]):.1f} mm from the search's"
    step = PlanStep("register.refined_pose", True, "the pose with which the fit ended", evidence)
    rmse_mm, plan = rms_mm(prepared.samples, Template.of(model, 0), pose), searched.plan + (step,)
    return replace(searched, model_from_scan=model_from_scan, face_scale=scale, rmse_mm=rmse_mm, plan=plan)


def judged_with_fit(searched: Registration, scan: RawScan, log_odds: float, figures: str) -> Registration:
    """Return the registration, as sure of a face as the search and the model's fit together are.

    Odds add: those of the search, and the `log_odds` that the fit gives. Raises NoFaceError, with the
    `figures` of the fit, where a face is too little probable then; a search that a budget ended refuses
    nothing.
    """
    if log_odds == 0:
        return searched
    chance = float(expit(logit(searched.confidence) + log_odds))
    if chance < LEAST_PROBABILITY and searched.converged:
        raise NoFaceError(
            f"{scan.name}: no face found. Bent onto the best pose, the model has a probability of "
            f"{chance:.2f} (needed: {LEAST_PROBABILITY:.2f}): {figures}; the scan's box is "
            f"{box_text(scan.vertices)}. "
            "Give a scan of a face in its true size (check the unit), or process it without a model",
            confidence=chance,
            model_from_scan=searched.model_from_scan,
        )
    return replace(searched, confidence=chance)
