"""One person's expression on another person's face, and a face model in one person's shape."""

import math
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from scan2albedo.core import RawScan
from scan2albedo.core.arrays import FloatArray, dots, norms
from scan2albedo.errors import ApplicationError
from scan2albedo.face_model import AnnotatedSurface, default_model
from scan2albedo.face_model.annotation import MOUTH_REGION
from scan2albedo.fitting import FitOptions, FittedFace, fit
from scan2albedo.fitting.dynamics import factorized
from scan2albedo.fitting.mouth_opening import ANGLES_DEG, JawHinge
from scan2albedo.geometry.loop_subdivision import LoopSubdivision
from scan2albedo.geometry.rigid import procrustes, transform_points
from scan2albedo.statistics.robust import geman_mcclure_weights
from scan2albedo.unlit.processed_face import SAME_PLACE_MM, FaceMesh, ProcessedFace, on_common_chart

Correspondence = Literal["auto", "refined", "as-fitted"]

TWO_PEOPLE_MM = 0.4
"""`apart_where_still` above which two faces are taken for two people: fits of light-stage people, at rest and
with expressions, gave up to 0.27 mm for one person, and for two 0.38 mm and more."""
REFIT = FitOptions(
    bending_mm=(20.0, 2.0),
    tangential=0.0,
    finest_level=0,
    rigid_iterations=0,
    proportion_iterations=0,
    scale_range=(1.0, 1.0),
    colors=True,
    covers=False,
    smoothing_mm=0.0,
)
"""One person twice, in one frame, without noise or glasses: pose, size and proportions are known; nothing
along the surface is to be believed but what keeps the sheet smooth."""


@dataclass(frozen=True)
class TransferOptions:
    """Settings of `transfer_expression`."""

    strength: float = 1.0
    """Factor of the displacement; less than 1 is a milder expression."""
    correspondence: Correspondence = "auto"
    """"as-fitted" believes that A's two fits put each vertex on one point of the skin; "refined" fits A at
    rest to the surface with the expression; "auto" refines faces on the model's own mesh, and no others."""

    def __post_init__(self) -> None:
        if self.correspondence not in (known := get_args(Correspondence)):
            raise ValueError(f"correspondence is {self.correspondence!r}, expected one of {known}")
        if not np.isfinite(self.strength):
            raise ValueError(f"strength must be finite, got {self.strength}")


def transfer_expression(
    neutral_a: ProcessedFace,
    expression_a: ProcessedFace,
    neutral_b: ProcessedFace,
    *,
    options: TransferOptions = TransferOptions(),
    model: AnnotatedSurface | None = None,
) -> ProcessedFace:
    """Return B with A's expression: B + (A's expression - A at rest), position by position on the chart.

    Albedo, reflectance and lights are B's; normals follow the new surface (Toderici et al., applications).
    Raises `ApplicationError` when the faces do not share a chart; when the correspondence is to be refined
    and they are not on the model's mesh.

    Parameters
    ----------
    neutral_a, expression_a, neutral_b : ProcessedFace
        Of one model and size.
    options : TransferOptions
    model : AnnotatedFaceModel, optional
        With which the faces were processed; the default model when omitted.

    Notes
    -----
    A's two heads are first aligned by the points that did not move. Their fits slide along the skin each in
    its own way, which is most of the error; `refined_expression` corrects it.
    """
    a, smiling, b = on_common_chart(neutral_a, expression_a, neutral_b)
    moved = expression_displacement(a.mesh, smiling.mesh, options=options, model=model)
    mask, mesh = b.mask, replace(b.mesh, vertices=b.mesh.vertices + moved)
    position = b.image.position[mask] + b.mesh.on_chart(moved, mask)
    return b.reshaped(mesh, position, f"{b.name}+{smiling.name}")


def expression_displacement(
    neutral_a: FaceMesh,
    expression_a: FaceMesh,
    *,
    options: TransferOptions = TransferOptions(),
    model: AnnotatedSurface | None = None,
) -> FloatArray:
    """Return (V, 3) mm by which each vertex moves between two meshes of the same triangles."""
    rest = neutral_a.vertices
    moved = laid_on_what_is_still(expression_a.vertices, rest)
    level = level_to_refine(neutral_a, options, model)
    if level is not None:
        used_model = model or default_model()
        moved = laid_on_what_is_still(refined_expression(neutral_a, moved, used_model, level), rest)
    return options.strength * (moved - rest)


def level_to_refine(
    neutral_a: FaceMesh, options: TransferOptions, model: AnnotatedSurface | None = None
) -> int | None:
    """Return the model's refinement that the mesh is; None where A's fits are taken as they are."""
    if options.correspondence == "as-fitted":
        return None
    used_model = model or default_model()
    level = refinement_level(neutral_a, used_model)
    if level is None and options.correspondence == "refined":
        raise ApplicationError(
            f"the correspondence cannot be refined: the faces are not on the mesh of {used_model.name!r}; "
            'give the model that they were processed with, or take correspondence "as-fitted"'
        )
    return level


def laid_on_what_is_still(moved: FloatArray, rest: FloatArray) -> FloatArray:
    """Return `moved` (V, 3) rigidly aligned to `rest` by the vertices that did not move.

    Iteratively reweighted least squares with Geman and McClure's weights, their scale the lower
    quartile of the distances of the round before: a smile leaves a quarter of the face still.
    """
    placed = moved
    for _ in range(20):
        distance = norms(placed - rest)
        scale = max(float(np.percentile(distance, 25)), 2 * SAME_PLACE_MM)
        weights = geman_mcclure_weights(distance, scale)
        before, placed = placed, transform_points(procrustes(moved, rest, weights=weights), moved)
        if np.abs(placed - before).max() < 1e-4:
            break
    return placed


def apart_where_still(neutral: FaceMesh, expression: FaceMesh) -> float:
    """Return the lower quartile of distances along the normal, mm, once aligned; see TWO_PEOPLE_MM."""
    placed = laid_on_what_is_still(expression.vertices, neutral.vertices)
    along = np.abs(dots(placed - neutral.vertices, neutral.normals))
    return float(np.percentile(along, 25))


def refined_expression(rest: FaceMesh, moved: FloatArray, model: AnnotatedSurface, level: int) -> FloatArray:
    """Return where each vertex of the face at rest is with the expression, (V, 3) mm.

    The face at rest becomes the model, its jaw turned by the angle between the two fits, and is fitted to the
    surface that the expression's fit found, without the film that spans an open mouth. `moved` (V, 3) is the
    same mesh fitted to the expression, in the frame of `rest`; `level` its `refinement_level`. FitError when
    the two surfaces do not lie together.
    """
    subdivision = model.subdivision(level)
    at_rest, as_fitted = (limit_control_points(v, subdivision) for v in (rest.vertices, moved))
    hinge, turned = JawHinge.of(model, at_rest), at_rest
    if hinge is not None:
        turned = hinge.opened(at_rest, float(np.clip(hinge.angle_deg(at_rest, as_fitted), 0, ANGLES_DEG[-1])))
    start = replace(model, control_vertices=turned)
    skin = ~model.in_region(MOUTH_REGION)[subdivision.parent]
    scan = RawScan(subdivision.matrix @ as_fitted, rest.faces[skin], name="the face with the expression")
    fitted = fit(scan, start, np.eye(4), options=REFIT)
    return rest.vertices + subdivision.matrix @ (fitted.control_points - at_rest)


def personal_model(
    face: FittedFace | ProcessedFace, model: AnnotatedSurface | None = None
) -> AnnotatedSurface:
    """Return a face's model with the control points that the fit found.

    Chart, regions, name and triangles stay, so faces processed with it go with faces processed with the model
    itself. `transfer_expression` does not need it: it finds corresponding points itself, and more exactly.
    The `face` is at rest; a ProcessedFace has no control points P: they are solved for by least squares, S P
    = vertices, S the subdivision's matrix. `model` is that of the fit, which a FittedFace knows, for other
    faces the default model when omitted; with another one raises `ApplicationError`.
    """
    if isinstance(face, FittedFace):
        return replace(face.model, control_vertices=face.control_points)
    template = default_model() if model is None else model
    if face.model_name != template.name:
        names = f"{face.model_name!r}, not {template.name!r}"
        raise ApplicationError(f"{face.name}: was processed with the model {names}; give that model")
    level = refinement_level(face.mesh, template)
    if level is not None:
        subdivision = template.subdivision(level)
        points = limit_control_points(face.mesh.vertices, subdivision)
        if np.abs(subdivision.matrix @ points - face.mesh.vertices).max() < SAME_PLACE_MM:
            return replace(template, control_vertices=points)
    raise ApplicationError(
        f"{face.name}: its surface is none of the model {template.name!r}; give the folder of a scan that "
        "was processed with this very model"
    )


def refinement_level(mesh: FaceMesh, model: AnnotatedSurface) -> int | None:
    """Return how often the model's control mesh is refined to these triangles; None when they are others."""
    level = round(math.log(len(mesh.faces) / len(model.control_faces), 4))
    same_count = len(mesh.faces) == len(model.control_faces) * 4**level
    return level if same_count and np.array_equal(model.subdivision(level).faces, mesh.faces) else None


def limit_control_points(vertices: FloatArray, subdivision: LoopSubdivision) -> FloatArray:
    """Return control points c (C, 3) with S c nearest to the vertices v (V, 3): S^T S c = S^T v."""
    matrix = subdivision.matrix
    return factorized(matrix.T @ matrix)(matrix.T @ vertices)
