"""Key points as JSON files, by name."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.keypoints import KEY_POINT_COUNT, KEY_POINT_NAMES
from scan2albedo.io.records import read_record, write_record

FloatArray = NDArray[np.float64]

_Coordinate = Annotated[float, Field(allow_inf_nan=False)]
_Point = tuple[_Coordinate, _Coordinate, _Coordinate]


class KeyPointsFile(BaseModel):
    """The content of a key-point file."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Literal["scan2albedo eyeglasses key points"] = "scan2albedo eyeglasses key points"
    format_version: Literal[1] = 1
    unit: Literal["mm", "cm", "m", "unknown"] = "unknown"
    """Of the coordinates."""
    key_points: dict[str, _Point | None] = Field(
        description="Coordinates by name; null, or no entry, where a key point was not found.",
        json_schema_extra={"propertyNames": {"enum": list(KEY_POINT_NAMES)}},
    )

    @model_validator(mode="after")
    def _names_are_known(self) -> KeyPointsFile:
        refuse_strange_names(self.key_points)
        return self


def refuse_strange_names(names: Iterable[str]) -> None:
    """Raise ValueError unless all are names of key points."""
    strange = sorted(set(names) - set(KEY_POINT_NAMES))
    if strange:
        raise ValueError(f"{strange[0]!r} is no key point; names are {', '.join(KEY_POINT_NAMES)}")


def write_keypoints(
    path: str | Path, keypoints: ArrayLike, unit: Literal["mm", "cm", "m", "unknown"] = "mm"
) -> None:
    """Write key points (20, 3), in the order of `KEY_POINT_NAMES`, as JSON; rows with NaN as null.

    Parameters
    ----------
    path : str or Path
    keypoints : (20, 3) array_like of float
    unit : {"mm", "cm", "m", "unknown"}
        Of the key points; only told in the file.

    Raises
    ------
    ValueError
        When the shape is another.
    OutputError
        When the file cannot be written.
    """
    points = np.asarray(keypoints, np.float64)
    if points.shape != (KEY_POINT_COUNT, 3):
        raise ValueError(f"keypoints must have shape ({KEY_POINT_COUNT}, 3), got {points.shape}")
    seen = [bool(np.isfinite(p).all()) for p in points]
    entries = {
        name: (float(p[0]), float(p[1]), float(p[2])) if found else None
        for name, p, found in zip(KEY_POINT_NAMES, points, seen, strict=True)
    }
    write_record(path, KeyPointsFile(unit=unit, key_points=entries))


@dataclass(frozen=True)
class KeyPoints:
    """Key points of a file: `points` (20, 3), NaN where one is missing, in `unit`."""

    points: FloatArray
    unit: Literal["mm", "cm", "m", "unknown"]


def read_keypoints(path: str | Path) -> FloatArray:
    """Return the key points (20, 3) of a file in the file's own unit, NaN where one is missing.

    Parameters
    ----------
    path : str or Path

    Raises
    ------
    EyeglassesError
        When the file cannot be read or is no key-point file; names the file and its first fault.
    """
    return read_keypoints_with_unit(path).points


def read_keypoints_with_unit(path: str | Path) -> KeyPoints:
    """Return what `read_keypoints` does, and the unit that the file states."""
    entry = read_record(
        path,
        KeyPointsFile,
        what="key points",
        advice="give a file that write_keypoints wrote (data_schemas/eyeglasses_keypoints.schema.json)",
        error=EyeglassesError,
    )
    nothing = (np.nan, np.nan, np.nan)
    points = np.array([entry.key_points.get(name) or nothing for name in KEY_POINT_NAMES], np.float64)
    return KeyPoints(points, entry.unit)
