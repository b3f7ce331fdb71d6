"""Morphable reflectance models as NPZ files with a header."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from scan2albedo.errors import ReflectanceError
from scan2albedo.io.npz import read_npz_record, write_npz_record
from scan2albedo.reflectance.morphable_model import MorphableReflectanceModel
from scan2albedo.reflectance.vertex_reflectance import EXPONENTS, refuse_other_lobes

_ARRAYS = {
    "known": "b",
    "support": "iu",
    "diffuse_mean": "f",
    "diffuse_basis": "f",
    "sum_mean": "f",
    "sum_basis": "f",
    "share_mean": "f",
    "share_basis": "f",
    "deviation": "f",
}
"""Names of the arrays in a file and their kinds."""


class ReflectanceModelHeader(BaseModel):
    """The text "header" in a file of a morphable reflectance model, as JSON.

    Beside it stand known (V,), support (V,), diffuse_mean (V, 3), diffuse_basis (N, V, 3), sum_mean (V,),
    sum_basis (N, V), share_mean (V, 3), share_basis (N, V, 3) and deviation (N,).
    """

    model_config = ConfigDict(extra="forbid", frozen=True, title="scan2albedo morphable reflectance model")

    format: Literal["scan2albedo reflectance model"] = "scan2albedo reflectance model"
    format_version: Literal[1] = 1
    exponents: tuple[float, float, float] = Field(description="Of the Blinn-Phong lobes, in their order.")
    samples: int = Field(ge=1, description="K, reflectances the model was learned from.")
    vertices: int = Field(ge=1, description="V.")
    components: int = Field(ge=0, description="N, directions of change.")
    total_variance: float = Field(ge=0, description="Of the samples' albedo, all vertices together.")


def write_model(path: str | Path, model: MorphableReflectanceModel) -> None:
    """Write a model as an .npz file, whole or not at all; same model, same bytes.

    Raises
    ------
    ValueError
        When the name does not end in .npz.
    OutputError
        When the file cannot be written.
    """
    header = ReflectanceModelHeader(
        exponents=EXPONENTS,
        samples=model.samples,
        vertices=len(model.known),
        components=model.components,
        total_variance=model.total_variance,
    )
    arrays = {name: getattr(model, name) for name in _ARRAYS}
    write_npz_record(path, header, arrays, what="reflectance model")


def read_model(path: str | Path) -> MorphableReflectanceModel:
    """Return the model of a file that `write_model` wrote.

    Raises
    ------
    ReflectanceError
        When the file is missing, damaged or something else; names it.
    """
    header, arrays = read_npz_record(
        path,
        ReflectanceModelHeader,
        _ARRAYS,
        what="reflectance model",
        advice="give a file that its `save` wrote (data_schemas/reflectance_model.schema.json)",
        error=ReflectanceError,
    )
    refuse_other_lobes(header.exponents, f"reflectance model {path}")
    found = arrays["deviation"].shape, arrays["known"].shape
    if found != ((header.components,), (header.vertices,)):
        raise ReflectanceError(
            f"reflectance model {path}: the header tells {header.components} components of {header.vertices} "
            f"vertices, the arrays are {found[0]} and {found[1]}; write the file again"
        )
    try:
        return MorphableReflectanceModel(
            **arrays, total_variance=header.total_variance, samples=header.samples
        )
    except ReflectanceError as error:
        raise ReflectanceError(f"{path}: {error}; write the file again") from error
