"""Morphable shape models as NPZ files with a header."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from scan2albedo.errors import ReflectanceError
from scan2albedo.io.atomic import atomic_path
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
    if Path(path).suffix != ".npz":
        raise ValueError(f"shape models are written as .npz, got {Path(path).name}")
    header = ShapeModelHeader(
        vertices=len(model.mean),
        identity_components=model.identity_components,
        expression_components=model.expression_components,
    )
    arrays = {name: getattr(model, name) for name in _ARRAYS}
    with atomic_path(path) as temporary:
        np.savez(temporary, header=np.array(header.model_dump_json()), **arrays)


def read_shape_model(path: str | Path) -> MorphableShapeModel:
    """Return the model of a file that `write_shape_model` wrote.

    Raises
    ------
    ReflectanceError
        When the file is missing, damaged or something else; names it.
    """
    arrays = _read_arrays(path)
    try:
        header = ShapeModelHeader.model_validate_json(str(arrays.pop("header")))
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "the header"
        raise ReflectanceError(
            f"shape model {path}: {where}: {first['msg']} ({error.error_count()} problems); expected a "
            "header as in data_schemas/shape_model.schema.json"
        ) from error
    for name, kinds in _ARRAYS.items():
        if arrays[name].dtype.kind not in kinds:
            raise ReflectanceError(f"shape model {path}: {name} holds {arrays[name].dtype}; write it again")
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


def _read_arrays(path: str | Path) -> dict[str, NDArray[Any]]:
    try:
        with np.load(io.BytesIO(Path(path).read_bytes()), allow_pickle=False) as file:
            return {name: file[name] for name in ("header", *_ARRAYS)}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, TypeError) as error:
        raise ReflectanceError(
            f"shape model {path} cannot be read ({' '.join(str(error).split())}); give a file that "
            "MorphableShapeModel.save wrote"
        ) from error
