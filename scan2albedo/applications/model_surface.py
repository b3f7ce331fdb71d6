"""A face's surface as the model's: which refinement of its control mesh, and which control points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scan2albedo.applications.processed_face import FaceMesh
from scan2albedo.face_model import AnnotatedFaceModel
from scan2albedo.geometry.loop_subdivision import LoopSubdivision

FloatArray = NDArray[np.float64]

_MOST_LEVELS = 4


def refinement_level(mesh: FaceMesh, model: AnnotatedFaceModel) -> int | None:
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
    from scan2albedo.fitting.dynamics import factorized

    matrix = subdivision.matrix
    return factorized(matrix.T @ matrix)(matrix.T @ vertices)
