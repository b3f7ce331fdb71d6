"""Anyone's face template from a mesh file, its vertices in the file's own order."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scan2albedo.errors import ModelError, ScanError
from scan2albedo.face_model.model import AnnotatedFaceModel
from scan2albedo.io.load_scan import SUPPORTED_SCANS, read_mesh_file

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

TEMPLATE_FILES = SUPPORTED_SCANS


def model_from_file(path: str | Path) -> AnnotatedFaceModel:
    """Make a model out of a template in an OBJ, PLY, GLB, glTF, STL or OFF file.

    The chart is the file's where every vertex has one texture coordinate, else a new one.

    Raises
    ------
    ModelError
        When the file cannot be read, or `AnnotatedFaceModel.from_mesh` cannot use the template.
    """
    file = Path(path)
    try:
        parsed = read_mesh_file(file)
    except ScanError as error:
        raise ModelError(f"template {error}") from error
    uv = None if parsed.uv is None else vertex_uv(len(parsed.vertices), parsed.faces, parsed.uv)
    return AnnotatedFaceModel.from_mesh(parsed.vertices, parsed.faces, uv, name=file.stem)


def vertex_uv(count: int, faces: IntArray, corner_uv: FloatArray) -> FloatArray | None:
    """Return (V, 2) coordinates where all corners of a vertex agree; None at seams and gaps.

    Vertices without a face get (0, 0).
    """
    uv = np.zeros((count, 2))
    uv[faces.ravel()] = corner_uv.reshape(-1, 2)
    agree = np.abs(uv[faces] - corner_uv) < 1e-6
    return uv if agree.all() else None
