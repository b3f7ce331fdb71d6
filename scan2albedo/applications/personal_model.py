"""`personal_model`: a face model in one person's shape, to fit that person's other scans from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from scan2albedo.applications.processed_face import FaceMesh, ProcessedFace
from scan2albedo.core.arrays import FloatArray
from scan2albedo.errors import ApplicationError
from scan2albedo.face_model import AnnotatedSurface, default_model
from scan2albedo.fitting import FittedFace
from scan2albedo.fitting.dynamics import factorized
from scan2albedo.geometry.loop_subdivision import LoopSubdivision

_MOST_LEVELS = 4
_SAME_SURFACE_MM = 0.05
"""A surface farther than this from one of the model is of another model."""


def personal_model(
    face: FittedFace | ProcessedFace, model: AnnotatedSurface | None = None
) -> AnnotatedSurface:
    """Return a face's model with the control points that the fit found.

    Chart, regions, name and triangles stay, so faces processed with it go with faces processed with the model
    itself. An expression fitted from the person's own face at rest, and not from the model's, leaves points
    that did not move mostly in their place. `transfer_expression` does not need it: it finds corresponding
    points itself, and more exactly (the figures are in docs/applications.md).

    Parameters
    ----------
    face : FittedFace or ProcessedFace
        Of the person at rest. Files hold the fitted surface and not its control points: for what
        `load_result` reads, they are solved for by least squares, S P = vertices, S the subdivision's matrix.
    model : AnnotatedFaceModel, optional
        Of the fit; a FittedFace knows its own, for other faces the default model when omitted.

    Raises
    ------
    ApplicationError
        When the face was not fitted with that model.
    """
    if isinstance(face, FittedFace):
        return replace(face.model, control_vertices=face.control_points)
    template = default_model() if model is None else model
    if face.model_name != template.name:
        raise ApplicationError(
            f"{face.name}: was processed with the model {face.model_name!r}, not {template.name!r}; give "
            "that model"
        )
    return replace(template, control_vertices=_control_points(face, template))


def _control_points(face: ProcessedFace, model: AnnotatedSurface) -> FloatArray:
    """Return (C, 3) mm: the control points whose limit surface is the face's."""
    level = refinement_level(face.mesh, model)
    if level is not None:
        subdivision = model.subdivision(level)
        points = limit_control_points(face.mesh.vertices, subdivision)
        if np.abs(subdivision.matrix @ points - face.mesh.vertices).max() < _SAME_SURFACE_MM:
            return points
    raise ApplicationError(
        f"{face.name}: its surface is none of the model {model.name!r}; give the folder of a scan that was "
        "processed with this very model"
    )


def refinement_level(mesh: FaceMesh, model: AnnotatedSurface) -> int | None:
    """Return how often the model's control mesh is refined to these triangles; None when they are others."""
    for level in range(_MOST_LEVELS + 1):
        if len(mesh.faces) == len(model.control_faces) * 4**level:
            same = np.array_equal(model.subdivision(level).faces, mesh.faces)
            return level if same else None
    return None


def limit_control_points(vertices: FloatArray, subdivision: LoopSubdivision) -> FloatArray:
    """Return the control points c (C, 3) whose limit surface S c is nearest to the vertices (V, 3).

    S^T S c = S^T v; exact where the vertices come from control points.
    """
    matrix = subdivision.matrix
    return factorized(matrix.T @ matrix)(matrix.T @ vertices)
