"""What the fit returns, and how it is assembled: residuals, coverage, metrics."""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from scan2albedo.core import Plan, PlanStep, Trace
from scan2albedo.core.arrays import EPSILON, SMALLEST, BoolArray, FloatArray, IntArray, dots, norms, rms
from scan2albedo.errors import FitError
from scan2albedo.face_model import default_model
from scan2albedo.face_model.annotation import FittedSurface
from scan2albedo.fitting.scan_surface import ScanSurface
from scan2albedo.fitting.stages import RESULT_LEVELS, Deformation, imbalance_mm
from scan2albedo.geometry.alignment import Alignment, Pairs, align
from scan2albedo.geometry.closest_points import MAX_EXACT_FACES, ClosestPointQuery
from scan2albedo.geometry.mesh import edges_with_faces, normalized, vertex_areas, vertex_normals

RESIDUAL_GATE_MM = 5.0
"""Residuals beyond this count as "no scan near"."""
MIN_COVERAGE = 0.1
"""Least part of the model's area with scan near it."""
MOST_IMBALANCE_MM = 0.2
"""Fits that ran to their end are within 0.03 mm of balance, on noise of 1 mm within 0.1 mm."""
MOST_STRAIN = 0.16
"""Most faces end with a strain of 0.04 to 0.07, wide smiles of up to 0.13; faces upside down of 0.17 and
more."""
_FACE_ODDS = {"intercept": -10.0, "strain": -6.0, "unreached": -6.0}
"""Log odds of a face by the logarithms of the strain and of what of the scan the model does not reach, chosen
so that both kinds lie far from 0. Fits to 51 real and modelled heads (foam heads, infants' proportions, shut
eyes and worn masks among them) and to 16 people in raw stereo have 4.6 and more, those to four parts of
machines that the search took for faces -6.8 and less; all of them were seen."""
_P95_MEDIANS = 6
"""Medians within which 95 % of a noisy scan's distances lie: 5.3 for a Student's t with two degrees of
freedom. Raw stereo with 6 mm of noise has 4 to 11, parts of machines 14 to 30."""
_LEAST_STRAIN = 0.02
"""Strain below which the model hardly had to bend."""
_REACHED_MM = 0.05
"""Added to what is not reached: a scan's own errors."""
NEAR_MM = 12.0
"""The surface around a landmark that shows it: about an eye's height."""
UNSEEN_MM = 4.0
"""Deviation along an axis of a landmark around which there is no scan."""
_FEATURES_MM = np.repeat((8.0, 4.2, 8.0, 2.2, 1.9, 1.1, 2.0, 2.1), (1, 15, 1, 10, 4, 5, 12, 20))
"""Deviation in mm along an axis of each landmark of iBUG-68: what
`tools/bench/landmarks.py` found on its faces. No others have judged it."""


@dataclass(frozen=True)
class FittedFace(FittedSurface):
    """The model deformed onto a scan; everything in the model's frame, mm."""

    control_points: FloatArray
    """(C, 3): deformed control mesh."""
    landmarks: FloatArray | None
    """(68, 3)."""
    template_vertices: FloatArray | None
    """(T, 3): the model's own template vertices carried along (`AnnotatedFaceModel.from_mesh`)."""
    converged: bool
    """False when a budget ended the fit, or something holds it far from balance (``imbalance_mm``)."""
    iterations: int
    """Steps taken."""
    trace: Trace
    """Stage "fit", mm."""
    scale: float = 1.0
    """Size of the face relative to the model."""
    coverage: float = 1.0
    """Part of the surface with scan near."""
    strain: float = 0.0
    """RMS logarithm of how the edges of the control mesh were stretched."""
    mirror_mm: float = np.inf
    """Median distance of the scan to its mirror image."""
    covered_mm2: float = 0.0
    """Area of the scan that was left out because it stands far before the eyes."""
    face_log_odds: float = 0.0
    """What speaks against a face there, at most 0."""
    metrics: dict[str, float] = field(default_factory=dict)
    """All figures for result.json. Beside those above: mean, median, p95 residual, flipped faces; how far the
    surface would still move (``imbalance_mm``), holes of the scan taken for open eyes and mouth
    (``openings``), landmarks that its colours draw (``painted_landmarks``), the jaw's angle (``jaw_deg``) and
    how far the mouth's corners were drawn back."""
    plan: Plan = Plan()
    """What is doubtful about the fit: "fit.<step>"."""
    covered_faces: BoolArray | None = None
    """(F,): faces of the raw scan that were left out because they stand far before the eyes; None: none."""
    landmark_deviation_mm: FloatArray | None = None
    """(68,): standard deviation of each landmark along an axis (`tools/bench/landmarks.py`)."""


def fitted_face(
    deformation: Deformation, q: FloatArray, ran: bool, model_from_scan: FloatArray, scale: float, name: str
) -> FittedFace:
    """Assemble the result of stages that reached the displacement `q` (C, 3); `ran`: all of them.

    The plan has a doubt when the model was stretched more than faces stretch it; raises `FitError` when less
    than MIN_COVERAGE of the surface has scan near it.
    """
    model, held = deformation.model, deformation.landmarks
    subdivision = model.subdivision(RESULT_LEVELS)
    control = deformation.reference + q
    vertices, faces = subdivision.matrix @ control, subdivision.faces
    exact = not deformation.meter.out_of_time
    residual = residuals_mm(deformation.scan, vertices, faces, RESIDUAL_GATE_MM, exact=exact)
    area, seen = vertex_areas(vertices, faces), ~np.isnan(residual)
    coverage = float(area[seen].sum() / max(area.sum(), SMALLEST))
    if coverage < MIN_COVERAGE:
        raise FitError(
            f"{name}: only {100 * coverage:.1f} % of the fitted model has scan within "
            f"{RESIDUAL_GATE_MM:.0f} mm, at least {100 * MIN_COVERAGE:.0f} % needed; "
            "the pose is wrong, or the scan holds too little of a face"
        )
    known = residual[seen]
    median_mm, p95_mm = float(np.median(known)), float(np.percentile(known, 95))
    strain = edge_strain(model.control_faces, deformation.reference, control)
    # Other models than the default one may have to bend as far to faces.
    judged = ran and model.control_vertices is default_model().control_vertices
    # Vertices of a coarser refinement come first.
    coarse = slice(len(model.surface(1)[0]))
    figures = {
        "coverage": coverage,
        "covered_mm2": deformation.covered_mm2,
        "strain": strain,
        "scale": scale,
        "face_log_odds": face_log_odds(strain, median_mm, p95_mm) if judged else 0.0,
        "mirror_mm": mirror_distance_mm(deformation.scan, vertices[coarse][seen[coarse]]),
    }
    imbalance = imbalance_mm(deformation, q)
    plan = Plan()
    if strain > MOST_STRAIN:
        reason = (
            f"the fit stretched the model's edges by {100 * strain:.0f} % (RMS), people's faces by about "
            "5 %: the pose is wrong, the scan holds no face, or it is very noisy"
        )
        plan += [PlanStep.doubt("fit.strain", reason)]
    landmarks = model.landmarks_of(control)
    deviation = None if landmarks is None else landmark_deviation_mm(landmarks, vertices, residual)
    if deviation is not None and held is not None:
        placed = held.numbers >= 0
        numbers = held.numbers[placed]
        deviation[numbers] = 1 / np.hypot(1 / deviation[numbers], 1 / held.sigma_mm[placed])
    return FittedFace(
        vertices=vertices,
        faces=faces,
        uv=model.refined_uv(RESULT_LEVELS),
        region=model.region[subdivision.parent],
        control_points=control,
        landmarks=landmarks,
        residual_mm=residual,
        model_from_scan=model_from_scan,
        template_vertices=model.template_of(control),
        levels=RESULT_LEVELS,
        converged=ran and imbalance <= MOST_IMBALANCE_MM,
        iterations=deformation.meter.evaluations,
        trace=deformation.meter.trace,
        model=model,
        scale=scale,
        coverage=coverage,
        strain=strain,
        mirror_mm=figures["mirror_mm"],
        covered_mm2=deformation.covered_mm2,
        face_log_odds=figures["face_log_odds"],
        metrics={
            **figures,
            "residual_mean_mm": float(known.mean()),
            "residual_median_mm": median_mm,
            "residual_p95_mm": p95_mm,
            "imbalance_mm": imbalance,
            "openings": 0.0 if held is None else float(held.openings),
            "painted_landmarks": 0.0 if held is None else float(held.painted),
            "jaw_deg": deformation.jaw_deg,
            "corner_right_mm": deformation.corners_mm[0],
            "corner_left_mm": deformation.corners_mm[1],
            "flipped_faces": float(len(deformation.folds.find(vertices))),
        },
        plan=plan,
        landmark_deviation_mm=deviation,
    )


def edge_strain(faces: IntArray, rest: FloatArray, moved: FloatArray) -> float:
    """Return the RMS logarithm of how the edges of faces (F, 3) were stretched from `rest` (V, 3)."""
    edges, _ = edges_with_faces(faces)
    before, after = (norms(points[edges[:, 0]] - points[edges[:, 1]]) for points in (rest, moved))
    floor = EPSILON * float(before.mean())
    return rms(np.log(np.maximum(after, floor) / np.maximum(before, floor)))


def face_log_odds(strain: float, median_mm: float, p95_mm: float) -> float:
    """Return the log odds of a face under the model, given the strain and distances of its fit: at most 0.

    The model bends onto anything that is smooth, so that a good fit speaks for nothing. What speaks against a
    face is how far its edges had to be stretched, and what of the scan it did not reach all the same: of a
    scanner's errors, which have heavy tails, 95 % are below `_P95_MEDIANS` medians; of the steps and edges of
    other things far fewer are.
    """
    beyond_mm = max(p95_mm - _P95_MEDIANS * median_mm, 0.0)
    odds = (
        _FACE_ODDS["intercept"]
        + _FACE_ODDS["strain"] * float(np.log(max(strain, _LEAST_STRAIN)))
        + _FACE_ODDS["unreached"] * float(np.log(beyond_mm + _REACHED_MM))
    )
    return min(odds, 0.0)


def mirror_distance_mm(scan: ScanSurface, points: FloatArray) -> float:
    """Return the median distance, mm, of the mirror image of a scan to it.

    The image of the scan next to points (N, 3), in the frame of a model whose plane of symmetry is x = 0, is
    laid on the scan, along its normals.
    """

    def pairs(now: Alignment, image: FloatArray) -> Pairs:
        hits = scan.nearest.query(image)
        offset, normal = hits.points - image, normalized(scan.normals_at(hits))
        plane_mm = dots(offset, normal)
        spread = np.median(plane_mm**2) + EPSILON
        return Pairs(offset, normal, (spread / (spread + plane_mm**2)) ** 2)

    image = scan.nearest.query(points).points * [-1.0, 1.0, 1.0]
    laid = align(image, np.ones(len(image)), pairs, steps=20, scale_range=(1.0, 1.0))
    return float(np.median(scan.nearest.query(laid.pose.apply(image)).distance))


def residuals_mm(
    scan: ScanSurface, vertices: FloatArray, faces: IntArray, gate_mm: float, *, exact: bool = True
) -> FloatArray:
    """Return (V,) distances to the scan; NaN on its border, beyond the gate, or where it faces away."""
    exact = exact and len(scan.faces) <= MAX_EXACT_FACES
    hits = (ClosestPointQuery(scan.vertices, scan.faces) if exact else scan.nearest).query(vertices)
    facing = dots(scan.normals_at(hits), vertex_normals(vertices, faces)) > 0
    return np.where(~scan.on_boundary(hits) & (hits.distance < gate_mm) & facing, hits.distance, np.nan)


def landmark_deviation_mm(landmarks: FloatArray, vertices: FloatArray, residual_mm: FloatArray) -> FloatArray:
    """Return (68,) deviations along an axis, mm: more where no scan is near, or the fit lies off it."""
    unseen, off = np.ones(len(landmarks)), np.zeros(len(landmarks))
    for number, index in enumerate(cKDTree(vertices).query_ball_point(landmarks, NEAR_MM)):
        if index:
            seen = residual_mm[index][~np.isnan(residual_mm[index])]
            unseen[number] = 1 - len(seen) / len(index)
            off[number] = seen.mean() if len(seen) else 0.0
    return np.sqrt(_FEATURES_MM**2 + (UNSEEN_MM * unseen) ** 2 + off**2)
