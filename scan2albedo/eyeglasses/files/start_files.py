"""Poses to start a registration from, as JSON files."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from scan2albedo.errors import EyeglassesError
from scan2albedo.io.records import Matrix, plain_json, read_record, write_record
from scan2albedo.io.units import MM_PER_UNIT

FloatArray = NDArray[np.float64]

_ROUNDED = 1e-6
"""How far from a rotation the left 3x3 part may be."""


class StartFile(BaseModel):
    """The content of a file with a pose."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    format: Literal["scan2albedo eyeglasses start"] = "scan2albedo eyeglasses start"
    format_version: Literal[1] = 1
    unit: Literal["mm", "cm", "m"] = Field(description="Of the translation.")
    world_from_glasses: Matrix = Field(
        description="Row-major 4x4 acting on column vectors: the frame's own coordinates into the cameras' "
        "world; rigid."
    )

    @model_validator(mode="after")
    def _rigid(self) -> StartFile:
        matrix = np.array(self.world_from_glasses)
        rotation = matrix[:3, :3]
        off = np.abs(rotation @ rotation.T - np.eye(3)).max()
        if not (off <= _ROUNDED and np.linalg.det(rotation) > 0 and (matrix[3] == [0, 0, 0, 1]).all()):
            raise ValueError("world_from_glasses must be a rotation and a translation over the row 0 0 0 1")
        return self


def write_start(
    path: str | Path, world_from_glasses: ArrayLike, unit: Literal["mm", "cm", "m"] = "mm"
) -> None:
    """Write a pose (4, 4) as JSON, atomically.

    Parameters
    ----------
    path : str or Path
    world_from_glasses : (4, 4) array_like of float
        Rigid.
    unit : {"mm", "cm", "m"}
        Of the translation; only told in the file.

    Raises
    ------
    ValueError
        When it is no rigid transform.
    OutputError
        When the file cannot be written.
    """
    content = StartFile(unit=unit, world_from_glasses=plain_json(np.asarray(world_from_glasses, np.float64)))
    write_record(path, content)


def read_start(path: str | Path) -> FloatArray:
    """Return the pose (4, 4) of a file, its translation in mm.

    Parameters
    ----------
    path : str or Path

    Raises
    ------
    EyeglassesError
        When the file cannot be read or holds no rigid transform; names it.
    """
    content = read_record(
        path,
        StartFile,
        what="start",
        advice="give a file that write_start wrote (data_schemas/eyeglasses_start.schema.json)",
        error=EyeglassesError,
    )
    pose = np.array(content.world_from_glasses)
    pose[:3, 3] *= MM_PER_UNIT[content.unit]
    return pose
