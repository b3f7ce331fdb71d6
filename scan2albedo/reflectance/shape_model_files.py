"""Morphable shape models as NPZ files with a header."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from scan2albedo.errors import ReflectanceError
from scan2albedo.io.npz import read_npz_record, write_npz_record
from scan2albedo.reflectance.shape_model import MorphableShapeModel

_ARRAYS = {
    "mean": "f",
    "identity_basis": "f",
    "expression_basis": "f",
    "faces": "iu",
    "landmark_vertices": "iu",
}
"""Names of the arrays in a file and their kinds."""


class ShapeModelHeader(BaseModel):
    """The text "header" in a file of a morphable shape model, as JSON.

    Beside it stand mean (V, 3), identity_basis (N_S, V, 3) and expression_basis (N_E, V, 3) in mm,
    faces (F, 3) and landmark_vertices (68,).
    """

    model_config = ConfigDict(extra="forbid", frozen=True, title="scan2albedo morphable shape model")

    format: Literal["scan2albedo shape model"] = "scan2albedo shape model"
    format_version: Literal[1] = 1
    vertices: int = Field(ge=1, description="V.")
    identity_components: int = Field(ge=0, description="N_S.")
    expression_components: int = Field(ge=0, description="N_E.")


def write_shape_model(path: str | Path, model: MorphableShapeModel) -> None:
    """Write a model as an .npz file, whole or not at all; same model, same bytes.

    Raises
    ------
    ValueError
        When the name does not end in .npz.
    OutputError
        When the file cannot be written.
    """
    header = ShapeModelHeader(
        vertices=len(model.mean),
        identity_components=model.identity_components,
        expression_components=model.expression_components,
    )
    arrays = {name: getattr(model, name) for name in _ARRAYS}
    write_npz_record(path, header, arrays, what="shape model")


def read_shape_model(path: str | Path) -> MorphableShapeModel:
    """Return the model of a file that `write_shape_model` wrote.

    Raises
    ------
    ReflectanceError
        When the file is missing, damaged or something else; names it.
    """
    header, arrays = read_npz_record(
        path,
        ShapeModelHeader,
        _ARRAYS,
        what="shape model",
        advice="give a file that MorphableShapeModel.save wrote (data_schemas/shape_model.schema.json)",
        error=ReflectanceError,
    )
    found = tuple(len(np.atleast_1d(arrays[n])) for n in ("mean", "identity_basis", "expression_basis"))
    told = header.vertices, header.identity_components, header.expression_components
    if found != told:
        raise ReflectanceError(
            f"shape model {path}: the header tells (vertices, identity, expression) = {told}, the arrays "
            f"hold {found}; write the file again"
        )
    try:
        return MorphableShapeModel(**arrays)
    except ReflectanceError as error:
        raise ReflectanceError(f"{path}: {error}; write the file again") from error
