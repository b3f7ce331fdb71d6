"""From the displacement reached to the `FittedFace` returned: residuals, coverage, metrics."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scan2albedo.errors import FitError
from scan2albedo.face_model.from_mesh import carried_template
from scan2albedo.fitting.result import FittedFace
from scan2albedo.fitting.scan_surface import ScanSurface
from scan2albedo.fitting.stages import Deformation, StagesOutcome
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.loop_subdivision import LoopSubdivision
from scan2albedo.geometry.mesh import vertex_areas, vertex_normals
from scan2albedo.geometry.nearest_surface import MAX_EXACT_FACES
from scan2albedo.geometry.operators import linear_refinement

FloatArray = NDArray[np.float64]


def fitted_face(
    deformation: Deformation,
    outcome: StagesOutcome,
    model_from_scan: FloatArray,
    scale: float,
    name: str,
) -> FittedFace:
    """Assemble the result.

    Raises
    ------
    FitError
        When less than `FitOptions.min_coverage` of the surface has scan near it.
    """
    model, options = deformation.model, deformation.options
    subdivision = model.subdivision(options.result_levels)
    control = deformation.reference + outcome.q
    vertices = subdivision.matrix @ control
    residual = residuals_mm(deformation.scan, vertices, subdivision.faces, options.residual_gate_mm)
    metrics = _metrics(vertices, residual, subdivision)
    metrics["flipped_faces"] = float(len(deformation.folds.find(vertices)))
    if metrics["coverage"] < options.min_coverage:
        raise FitError(
            f"{name}: only {100 * metrics['coverage']:.1f} % of the fitted model has scan within "
            f"{options.residual_gate_mm:.0f} mm, at least {100 * options.min_coverage:.0f} % needed; "
            "the pose is wrong, or the scan holds too little of a face"
        )
    return FittedFace(
        vertices=vertices,
        faces=subdivision.faces,
        uv=linear_refinement(len(control), model.control_faces, options.result_levels) @ model.uv,
        region=model.region[subdivision.parent],
        control_points=control,
        landmarks=model.landmarks_of(control),
        residual_mm=residual,
        model_from_scan=model_from_scan,
        template_vertices=carried_template(model, control),
        levels=options.result_levels,
        converged=outcome.converged,
        iterations=deformation.meter.evaluations,
        trace=deformation.meter.trace,
        model=model,
        metrics={**metrics, "scale": scale},
    )


def residuals_mm(
    scan: ScanSurface, vertices: FloatArray, faces: NDArray[np.int64], gate_mm: float
) -> FloatArray:
    """Return (V,) distances to the scan; NaN on its border, beyond the gate, or where it faces away."""
    exact = len(scan.faces) <= MAX_EXACT_FACES
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
