"""Deform the model onto a registered scan."""

from collections.abc import Callable
from dataclasses import replace
from typing import Protocol

import numpy as np

from scan2albedo.core import BudgetLike, Meter, OnProgress, Plan, PlanStep, RawScan
from scan2albedo.core.arguments import described, require_type
from scan2albedo.core.arrays import FloatArray
from scan2albedo.errors import FitError
from scan2albedo.face_model import AnnotatedSurface
from scan2albedo.fitting.alignment import SIZE_SD, aligned, proportioned
from scan2albedo.fitting.covers import uncovered
from scan2albedo.fitting.forces import MIN_ROBUST_MM, ForceGates
from scan2albedo.fitting.landmark_pull import WRONG_MM, LandmarkPull, joined, openings
from scan2albedo.fitting.mouth_opening import corners_pulled, mouth_opened
from scan2albedo.fitting.options import GATE_MM, FitOptions
from scan2albedo.fitting.painted_features import painted_pull
from scan2albedo.fitting.result import FittedFace, fitted_face
from scan2albedo.fitting.samples import SurfaceSamples
from scan2albedo.fitting.scan_surface import ScanSurface, scan_near_model
from scan2albedo.fitting.stages import Deformation, run_stages
from scan2albedo.geometry.mesh import face_areas
from scan2albedo.geometry.rigid import invert_rigid, is_rigid, transform_points

CROP_MARGIN = 0.35
"""Part of the model's size by which the scan may reach beyond the model and still be looked at."""
MIN_FIRST_CONTACT = 0.03
"""Least part of the model's area with scan near before it bends."""
Cue = Callable[[RawScan, FloatArray, AnnotatedSurface, FloatArray], LandmarkPull | None]
CUES: list[Cue] = [painted_pull]
"""What shows landmarks on a scan, from scan, pose (4, 4), model and control points (C, 3); add your own."""


class Posed(Protocol):
    """Anything that knows the pose of the scan in the model's frame."""

    @property
    def model_from_scan(self) -> FloatArray:
        """(4, 4) rigid transform."""


def fit(
    scan: RawScan,
    model: AnnotatedSurface,
    reg: Posed | FloatArray,
    budget: BudgetLike = None,
    *,
    options: FitOptions | None = None,
    on_progress: OnProgress = None,
) -> FittedFace:
    """Return the model's limit surface deformed onto a scan, with the refined pose.

    The control points P = s P_0 + q follow M q'' + D q' + K q = f [1]_, with K the membrane and thin-plate
    energy of q weighted by each region's stiffness, and f the forces of the scan on samples of the limit
    surface [2]_. Before that, pose and size s are refined, lenses before the eyes are left out, the mouth is
    opened and its corners drawn back, brows, eyes and lips are looked for in the colours, and the face gets
    its proportions.

    Raises FitError when there is next to no scan where the model is; TypeError for other objects than a scan,
    a model and a pose; ValueError when the pose is not rigid.

    Parameters
    ----------
    scan, model : RawScan, AnnotatedFaceModel
    reg : object with `model_from_scan`, or (4, 4) array
        Rigid pose, good to about 15 degrees and 15 mm.
    budget : Budget, float or None
        Seconds, or evaluations (steps). When it ends, the face so far is returned with ``converged=False``.
    options : FitOptions, optional
    on_progress : callable, optional
        Called with each trace row.

    Notes
    -----
    The linear finite elements of [1]_ are replaced by the cotangent Laplacian of the control mesh, and its
    damping by the implicit treatment of the forces' stiffness (`ImplicitSystem`). A step costs O(samples).

    .. [1] G. Toderici, G. Passalis, T. Theoharis, I. Kakadiaris, "An Automated Method for Human Face
       Modeling and Relighting with Application to Face Recognition", section 3.1.2.
    .. [2] C. Mandal, H. Qin, B. Vemuri, "A Novel FEM-Based Dynamic Framework for Subdivision Surfaces",
       Computer-Aided Design 32, 2000.
    """
    require_type(scan, RawScan, "fit: scan", "load_scan(path) returns one")
    require_type(model, AnnotatedSurface, "fit: model", "AnnotatedFaceModel.default() returns one")
    require_type(options, (FitOptions, type(None)), "fit: options", "make them with FitOptions()")
    chosen = options or FitOptions()
    pose = _rigid_pose(reg)
    meter = Meter("fit", "mm", budget, on_progress)
    samples = SurfaceSamples.of(model, model.control_vertices, 0)
    surface = scan_near(scan, samples, model.control_vertices, pose, chosen)
    pull = joined(LandmarkPull.of(model, scan.landmarks, pose), openings(surface, model))
    # Cheeks and forehead fit at many poses and sizes; nose, lids and lips do not.
    weight = samples.area * samples.rigidity * samples.relief(samples.matrix @ model.control_vertices)
    gates = ForceGates(GATE_MM[0], chosen.tangential, MIN_ROBUST_MM[1])
    similarity = aligned(
        surface,
        samples,
        model.control_vertices,
        weight,
        lambda step: gates,
        np.array([[SIZE_SD**-2]]),
        steps=chosen.rigid_iterations,
        scale_range=chosen.scale_range,
        meter=meter,
        landmarks=pull,
    ).pose
    hits = surface.nearest.query(similarity.apply(samples.matrix @ model.control_vertices))
    reached = (hits.distance < GATE_MM[0]) & ~surface.on_boundary(hits)
    share = float(samples.area[reached].sum() / samples.area.sum())
    if share < MIN_FIRST_CONTACT:
        raise FitError(
            f"{scan.name}: only {100 * share:.1f} % of the model has scan within {GATE_MM[0]:.0f} mm, at "
            f"least {100 * MIN_FIRST_CONTACT:.0f} % needed; the pose is wrong, or the scan holds no face"
        )
    # The scan comes to the model, which keeps its frame and its front, and takes the size.
    correction = invert_rigid(similarity.rigid(model.front))
    pose, surface = correction @ pose, surface.moved(correction)
    pull = None if pull is None else pull.moved(correction)
    reference = model.front + similarity.scale * (model.control_vertices - model.front)
    steps = list[PlanStep]()
    bare, covers = uncovered(surface, model, reference, meter) if chosen.covers else (surface, None)
    covered = np.zeros(len(scan.faces), bool)
    covered_mm2 = 0.0
    if covers is not None:
        covered_mm2 = float(face_areas(covers.vertices, covers.faces).sum())
        reason = (
            f"{covered_mm2 / 100:.0f} cm2 of the scan lie far before the eyes, as glasses do; they are "
            "left out, and the model's own shape stands there"
        )
        steps.append(PlanStep.doubt("fit.covers", reason))
        points = transform_points(pose, scan.vertices)
        apart, behind = (part.nearest.query(points).distance for part in (covers, bare))
        covered = np.any((apart <= behind)[scan.faces], axis=1)
    deformation = Deformation(model, reference, bare, chosen, meter, covered_mm2=covered_mm2)
    deformation = corners_pulled(mouth_opened(deformation, pull))
    if chosen.colors and not meter.exhausted:
        shown = scan.without_faces(covered) if covered.any() else scan
        pull = joined(pull, *(cue(shown, pose, model, deformation.reference) for cue in CUES))
    samples = SurfaceSamples.of(model, deformation.reference, 0)
    reference = proportioned(bare, samples, deformation.reference, chosen, meter, pull)
    if pull is not None:
        count = int((pull.numbers >= 0).sum())
        pull, left_out = pull.without_wrong(model, reference)
        if wrong := [number for number in left_out.tolist() if number >= 0]:
            reason = (
                f"{len(wrong)} of {count} landmarks (number {', '.join(map(str, wrong))}) lie more than "
                f"{WRONG_MM:.0f} mm from where the face and the others put them, and are left out: check "
                "their numbers, frame and unit"
            )
            steps.append(PlanStep.doubt("fit.landmarks", reason))
    if pull is not None:
        reference = pull.followed(model, reference)
        pull = pull.held(reference, bare)
    deformation = replace(deformation, reference=reference, landmarks=pull)
    q, ran = run_stages(deformation)
    fitted = fitted_face(deformation, q, ran, pose, similarity.scale, scan.name)
    return replace(
        fitted, covered_faces=covered if covered.any() else None, plan=Plan(tuple(steps)) + fitted.plan
    )


def _rigid_pose(reg: Posed | FloatArray) -> FloatArray:
    """Return the pose (4, 4) of a registration; TypeError and ValueError for what is none."""
    pose = reg if isinstance(reg, np.ndarray) else getattr(reg, "model_from_scan", None)
    if pose is None:
        raise TypeError(
            f"fit: reg is {described(reg)}, expected a Registration or a (4, 4) array; register(scan, model) "
            "returns one"
        )
    pose = np.asarray(pose, float)
    if pose.shape != (4, 4):
        raise ValueError(f"model_from_scan has shape {pose.shape}, expected (4, 4)")
    if not is_rigid(pose, 1e-3):
        raise ValueError("model_from_scan must be a rigid transform (rotation and translation, no scale)")
    return pose


def scan_near(
    scan: RawScan, samples: SurfaceSamples, control_points: FloatArray, pose: FloatArray, options: FitOptions
) -> ScanSurface:
    """Return the scan near control points (C, 3), in their frame, facing outward; FitError for none."""
    low, high = control_points.min(0), control_points.max(0)
    margin = CROP_MARGIN * float(np.max(high - low))
    near = scan_near_model(scan.vertices, scan.faces, pose, low - margin, high + margin, options.smoothing_mm)
    if near is None:
        raise FitError(
            f"{scan.name}: no part of the scan lies within {margin:.0f} mm of the model in the pose given; "
            "register the scan first, and check its unit"
        )
    points = samples.matrix @ control_points
    return near.turned_outward(points, samples.normals(points), GATE_MM[0])
