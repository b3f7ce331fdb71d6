"""Key points, and their labels in pictures, as JSON files."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from scan2albedo.core.arrays import FloatArray
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.checks import checked_keypoints
from scan2albedo.eyeglasses.files.camera_files import CameraName, require_distinct_names
from scan2albedo.eyeglasses.files.exchanged_key_points import exchanged_key_points
from scan2albedo.eyeglasses.files.json_files import LengthUnitIfKnown, read_json
from scan2albedo.eyeglasses.keypoints import KEY_POINT_COUNT, KEY_POINT_NAMES
from scan2albedo.io.records import Record, write_record

_Point = tuple[float, float, float]
_Pixel = tuple[float, float]


class KeyPointsFile(Record):
    """The content of a key-point file."""

    format: Literal["scan2albedo eyeglasses key points"] = "scan2albedo eyeglasses key points"
    format_version: Literal[1] = 1
    unit: LengthUnitIfKnown = "unknown"
    """Of the coordinates."""
    key_points: dict[str, _Point | None] = Field(
        description="Coordinates by name; null, or no entry, where a key point was not found.",
        json_schema_extra={"propertyNames": {"enum": list(KEY_POINT_NAMES)}},
    )

    @model_validator(mode="after")
    def _names_are_known(self) -> KeyPointsFile:
        require_known_names(self.key_points)
        return self


def require_known_names(names: Iterable[str]) -> None:
    """Raise ValueError, with the names that were probably meant, unless all are names of key points."""
    strange = sorted(set(names) - set(KEY_POINT_NAMES))
    if not strange:
        return
    guesses = {name: difflib.get_close_matches(name, KEY_POINT_NAMES, n=1) for name in strange}
    said = [f"{name!r} (probably {found[0]!r})" if found else repr(name) for name, found in guesses.items()]
    verb = "is no key point" if len(said) == 1 else "are no key points"
    raise ValueError(f"{', '.join(said)} {verb}; names are {', '.join(KEY_POINT_NAMES)}")


def write_keypoints(path: str | Path, keypoints: ArrayLike, unit: LengthUnitIfKnown = "mm") -> None:
    """Write key points (20, 3), in the order of `KEY_POINT_NAMES`, as JSON; rows with NaN as null.

    Raises ValueError when the shape is another, OutputError when the file cannot be written.

    Parameters
    ----------
    path : str or Path
    keypoints : (20, 3) array_like of float
    unit : {"mm", "cm", "m", "unknown"}
        Of the key points; only noted in the file.
    """
    points = checked_keypoints("keypoints", keypoints)
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
    unit: LengthUnitIfKnown


def read_keypoints(path: str | Path) -> FloatArray:
    """Return the key points (20, 3) of a file in the file's own unit, NaN where one is missing.

    Raises EyeglassesError, naming the file, when it cannot be read or is no key-point file, when it has
    names of no key points, or when key points lie where others belong (names exchanged).

    Parameters
    ----------
    path : str or Path
    """
    return read_keypoints_with_unit(path).points


def read_keypoints_with_unit(path: str | Path) -> KeyPoints:
    """Return what `read_keypoints` does, and the unit that the file states."""
    entry = read_json(
        path,
        KeyPointsFile,
        "key points",
        writer="write_keypoints",
        schema="eyeglasses_keypoints",
        hint="`scan2albedo glasses key-points` says which key points to place, and where",
    )
    nothing = (np.nan, np.nan, np.nan)
    points = np.array([entry.key_points.get(name) or nothing for name in KEY_POINT_NAMES], np.float64)
    if exchanged := "; ".join(exchanged_key_points(points)):
        raise EyeglassesError(
            f"key points {path}: names seem exchanged: {exchanged}. `scan2albedo glasses key-points` "
            "shows where each belongs; temples must be open, not folded"
        )
    return KeyPoints(points, entry.unit)


@dataclass(frozen=True)
class ViewLabels:
    """Labels of C views."""

    camera_names: tuple[str, ...]
    """Of the C views."""
    pixels: FloatArray
    """(C, 20, 2) column and row, centres of pixels at integers; NaN where a key point is not labelled."""

    def of_cameras(self, names: Sequence[str]) -> FloatArray:
        """Return (N, 20, 2) labels of the cameras `names`, in their order; NaN for one without labels.

        Raises EyeglassesError when there are labels of a camera that is not among them.
        """
        if strange := sorted(set(self.camera_names) - set(names)):
            raise EyeglassesError(
                f"there are labels of a camera {strange[0]!r}, but the cameras are {', '.join(names)}; "
                "add it to them, or take its labels out"
            )
        at = {name: i for i, name in enumerate(self.camera_names)}
        nothing = np.full((KEY_POINT_COUNT, 2), np.nan)
        return np.array([self.pixels[at[name]] if name in at else nothing for name in names])


class LabelsFile(Record):
    """The content of a label file."""

    format: Literal["scan2albedo eyeglasses labels"] = "scan2albedo eyeglasses labels"
    format_version: Literal[1] = 1
    views: dict[CameraName, dict[str, _Pixel | None]] = Field(
        description="Pixels (column, row) by camera and key point, centres of pixels at integers; null, or "
        "no entry, where a key point is not labelled.",
        json_schema_extra={
            "additionalProperties": {
                "type": "object",
                "propertyNames": {"enum": list(KEY_POINT_NAMES)},
                "additionalProperties": {
                    "anyOf": [
                        {"type": "array", "items": {"type": "number"}, "minItems": 2, "maxItems": 2},
                        {"type": "null"},
                    ]
                },
            }
        },
    )

    @model_validator(mode="after")
    def _names_are_known(self) -> LabelsFile:
        require_distinct_names(self.views)
        for labels in self.views.values():
            require_known_names(labels)
        return self


def write_labels(path: str | Path, labels: ArrayLike, camera_names: Sequence[str]) -> None:
    """Write labels (C, 20, 2) of C cameras as JSON; NaN as null.

    Parameters
    ----------
    path : str or Path
    labels : (C, 20, 2) array_like of float
        Column and row in pixels, in the order of `KEY_POINT_NAMES`.
    camera_names : sequence of C str

    Raises
    ------
    ValueError
        When the shape is another, or two cameras share a name.
    OutputError
        When the file cannot be written.
    """
    pixels = np.asarray(labels, np.float64)
    if pixels.shape != (len(camera_names), KEY_POINT_COUNT, 2):
        raise ValueError(
            f"labels must have shape ({len(camera_names)}, {KEY_POINT_COUNT}, 2) for {len(camera_names)} "
            f"cameras, got {pixels.shape}"
        )
    require_distinct_names(camera_names)
    views = {
        name: {
            key_point: (float(p[0]), float(p[1])) if np.isfinite(p).all() else None
            for key_point, p in zip(KEY_POINT_NAMES, view, strict=True)
        }
        for name, view in zip(camera_names, pixels, strict=True)
    }
    write_record(path, LabelsFile(views=views))


def read_labels(path: str | Path) -> ViewLabels:
    """Return the labels of a file, NaN where one is missing.

    Raises EyeglassesError, naming the file and its first fault, when it cannot be read or is no label file.

    Parameters
    ----------
    path : str or Path
    """
    content = read_json(path, LabelsFile, "labels", writer="write_labels", schema="eyeglasses_labels")
    nothing = (np.nan, np.nan)
    pixels = [[view.get(name) or nothing for name in KEY_POINT_NAMES] for view in content.views.values()]
    shape = (len(content.views), KEY_POINT_COUNT, 2)
    return ViewLabels(tuple(content.views), np.array(pixels, np.float64).reshape(shape))
