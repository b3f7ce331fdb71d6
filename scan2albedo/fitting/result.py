"""What the fit returns, and how it is assembled: residuals, coverage, metrics."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core import Plan, PlanStep, Trace
from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.errors import FitError
from scan2albedo.face_model import AnnotatedSurface
from scan2albedo.fitting.landmark_deviation import landmark_deviation_mm
from scan2albedo.fitting.scan_surface import ScanSurface
from scan2albedo.fitting.stages import Deformation, StagesResult, imbalance_mm
from scan2albedo.geometry.closest_points import MAX_EXACT_FACES, ClosestPointQuery
from scan2albedo.geometry.loop_subdivision import LoopSubdivision
from scan2albedo.geometry.mesh import edges_with_faces, vertex_areas, vertex_normals

RESIDUAL_GATE_MM = 5.0
"""Residuals beyond this count as "no scan near"."""
MIN_COVERAGE = 0.1
"""Least part of the model's area that must have scan near it."""
MOST_IMBALANCE_MM = 0.2
"""Fits that ran to their end are within 0.03 mm of balance, on noise of 1 mm within 0.1 mm."""
MOST_STRAIN = 0.16
"""Most faces end at 0.04 to 0.07, wide smiles at up to 0.13; faces upside down at 0.17 and more."""


@dataclass(frozen=True)
class FittedFace:
    """The model deformed onto a scan; everything in the model's frame, mm."""

    vertices: FloatArray
    """(V, 3): limit surface points, V from `levels` refinements of the control mesh."""
    faces: IntArray
    """(F, 3)."""
    uv: FloatArray
    """(V, 2): chart coordinates of `vertices`."""
    region: NDArray[np.uint8]
    """(F,): region index of each face."""
    control_points: FloatArray
    """(C, 3): deformed control mesh."""
    landmarks: FloatArray | None
    """(68, 3)."""
    residual_mm: FloatArray
    """(V,): distance of each vertex to the scan; NaN where the scan has no surface near (hole, outside)."""
    model_from_scan: FloatArray
    """(4, 4): pose used; the fit may refine it."""
    template_vertices: FloatArray | None
    """(T, 3): the model's own template vertices carried along (`AnnotatedFaceModel.from_mesh`)."""
    levels: int
    """Loop refinements of `vertices`."""
    converged: bool
    """False when a budget ended the fit, or something holds it far from balance (``imbalance_mm``)."""
    iterations: int
    """Steps taken."""
    trace: Trace
    """Stage "fit", mm."""
    model: AnnotatedSurface
    """That was fitted."""
    metrics: dict[str, float] = field(default_factory=dict)
    """Mean, median, p95 residual, coverage, flipped faces; how far the surface would still move
    (``imbalance_mm``), the RMS logarithm of how its edges were stretched (``strain``), how many holes of the
    scan were taken for open eyes and mouth (``openings``), how many landmarks its colours
    draw (``painted_landmarks``), and what was decided of the mouth: the jaw's angle
    (``jaw_deg``) and how far its corners were drawn back; how much of the scan was left out because it stands
    far before the eyes (``covered_mm2``): for result.json."""
    plan: Plan = Plan()
    """What is doubtful about the fit: "fit.<step>"."""
    covered_faces: BoolArray | None = None
    """(F,): faces of the raw scan that were left out because they stand far before the eyes; None: none."""
    landmark_deviation_mm: FloatArray | None = None
    """(68,): standard deviation of each landmark along an axis (`tools/bench_landmarks.py`)."""


def fitted_face(
    deformation: Deformation,
    reached: StagesResult,
    model_from_scan: FloatArray,
    scale: float,
    name: str,
) -> FittedFace:
    """Assemble the result.

    The plan has a doubt when the model was stretched more than faces stretch it; raises `FitError` when less
    than MIN_COVERAGE of the surface has scan near it.
    """
    model, options = deformation.model, deformation.options
    subdivision = model.subdivision(options.result_levels)
    control = deformation.reference + reached.q
    vertices = subdivision.matrix @ control
    residual = residuals_mm(
        deformation.scan,
        vertices,
        subdivision.faces,
        RESIDUAL_GATE_MM,
        exact=not deformation.meter.out_of_time,
    )
    metrics = _metrics(vertices, residual, subdivision)
    metrics["imbalance_mm"] = imbalance_mm(deformation, reached.q)
    pull = deformation.landmarks
    metrics["openings"] = 0.0 if pull is None else float(pull.openings)
    metrics["painted_landmarks"] = 0.0 if pull is None else float(pull.painted)
    metrics["jaw_deg"] = deformation.jaw_deg
    metrics["corner_right_mm"], metrics["corner_left_mm"] = deformation.corners_mm
    metrics["covered_mm2"] = deformation.covered_mm2
    metrics["strain"] = _strain(deformation.reference, control, model.control_faces)
    metrics["flipped_faces"] = float(len(deformation.folds.find(vertices)))
    if metrics["coverage"] < MIN_COVERAGE:
        raise FitError(
            f"{name}: only {100 * metrics['coverage']:.1f} % of the fitted model has scan within "
            f"{RESIDUAL_GATE_MM:.0f} mm, at least {100 * MIN_COVERAGE:.0f} % needed; "
            "the pose is wrong, or the scan holds too little of a face"
        )
    plan = Plan()
    if (strain := metrics["strain"]) > MOST_STRAIN:
        reason = (
            f"the fit stretched the model's edges by {100 * strain:.0f} % (RMS), people's faces by about "
            "5 %: the pose is wrong, the scan holds no face, or it is very noisy"
        )
        plan += [PlanStep.doubt("fit.strain", reason)]
    landmarks = model.landmarks_of(control)
    deviation = None if landmarks is None else landmark_deviation_mm(landmarks, vertices, residual)
    if deviation is not None and (held := deformation.landmarks) is not None:
        placed = held.numbers >= 0
        numbers = held.numbers[placed]
        deviation[numbers] = 1 / np.hypot(1 / deviation[numbers], 1 / held.sigma_mm[placed])
    return FittedFace(
        vertices=vertices,
        faces=subdivision.faces,
        uv=model.refined_uv(options.result_levels),
        region=model.region[subdivision.parent],
        control_points=control,
        landmarks=landmarks,
        residual_mm=residual,
        model_from_scan=model_from_scan,
        template_vertices=model.template_of(control),
        levels=options.result_levels,
        converged=reached.converged and metrics["imbalance_mm"] <= MOST_IMBALANCE_MM,
        iterations=deformation.meter.evaluations,
        trace=deformation.meter.trace,
        model=model,
        metrics={**metrics, "scale": scale},
        plan=plan,
        landmark_deviation_mm=deviation,
    )


def residuals_mm(
    scan: ScanSurface, vertices: FloatArray, faces: IntArray, gate_mm: float, *, exact: bool = True
) -> FloatArray:
    """Return (V,) distances to the scan; NaN on its border, beyond the gate, or where it faces away."""
    exact = exact and len(scan.faces) <= MAX_EXACT_FACES
    query = ClosestPointQuery(scan.vertices, scan.faces) if exact else scan.nearest
    hits = query.query(vertices)
    facing = np.einsum("ij,ij->i", scan.normals_at(hits), vertex_normals(vertices, faces)) > 0
    seen = ~scan.on_boundary(hits) & (hits.distance < gate_mm) & facing
    return np.where(seen, hits.distance, np.nan)


def _metrics(vertices: FloatArray, residual: FloatArray, subdivision: LoopSubdivision) -> dict[str, float]:
    area = vertex_areas(vertices, subdivision.faces)
    seen = ~np.isnan(residual)
    known = residual[seen] if seen.any() else np.array([np.nan])
    return {
        "residual_mean_mm": float(known.mean()),
        "residual_median_mm": float(np.median(known)),
        "residual_p95_mm": float(np.percentile(known, 95)),
        "coverage": float(area[seen].sum() / max(area.sum(), 1e-300)),
    }


def _strain(before: FloatArray, after: FloatArray, faces: IntArray) -> float:
    """Return the RMS of log(length after / length before) over the edges of the control mesh."""
    edges, _ = edges_with_faces(faces)
    lengths = [
        np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1) for points in (before, after)
    ]
    floor = 1e-6 * float(lengths[0].mean())
    return float(np.sqrt(np.mean(np.log(np.maximum(lengths[1], floor) / np.maximum(lengths[0], floor)) ** 2)))
