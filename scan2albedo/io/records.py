"""Records: JSON files with a schema, written whole and checked when they are read."""

import math
import sys
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import is_dataclass, replace
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    JsonValue,
    ValidationError,
    field_validator,
)

from scan2albedo.core.arrays import Texts
from scan2albedo.errors import Scan2AlbedoError, one_line, printable
from scan2albedo.io.atomic import write_text
from scan2albedo.io.csv_tables import read_text
from scan2albedo.io.limits import FILE_BYTES
from scan2albedo.io.publication import check_whole

_LIBRARIES = ("numpy", "scipy", "numba", "libigl", "open3d-cpu", "open3d", "embreex", "xatlas", "trimesh")

Content = TypeVar("Content", bound=BaseModel)


def plain_json(value: Any) -> Any:
    """Return a value in JSON's own types: numpy unwrapped, paths as text, what no float holds as null.

    >>> plain_json({"sigma": np.float64(0.3), "distance": math.inf, "size": (2, 3)})
    {'sigma': 0.3, 'distance': None, 'size': [2, 3]}
    """
    if isinstance(value, np.ndarray | np.generic):
        return plain_json(value.tolist())
    if isinstance(value, Mapping):
        return {str(key): plain_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain_json(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, int) and abs(value) > sys.float_info.max:
        return None
    return str(value) if isinstance(value, Path) else value


_PLAIN = BeforeValidator(plain_json)
"""Stands last: limits before it are those of the number itself, which the schema tells."""
Figures = Annotated[dict[str, JsonValue], _PLAIN]
Number = Annotated[float, _PLAIN]
OptionalNumber = Annotated[float | None, _PLAIN]
NonNegative = Annotated[float, Field(ge=0), _PLAIN]
Positive = Annotated[float, Field(gt=0), _PLAIN]
Share = Annotated[float, Field(ge=0, le=1), _PLAIN]
Count = Annotated[int, Field(ge=0)]
PositiveCount = Annotated[int, Field(ge=1)]
Name = Annotated[str, Field(min_length=1)]
OwnFileNames = Annotated[Texts, Field(description="Names of the files beside this one.")]
CalledWith = Annotated[Figures, Field(description="What the run was called with.")]
Row = tuple[float, float, float, float]
Matrix = Annotated[tuple[Row, Row, Row, Row], _PLAIN]


def _printable_texts(value: Any) -> Any:
    if isinstance(value, str):
        return printable(value)
    if isinstance(value, dict):
        return {_printable_texts(key): _printable_texts(item) for key, item in value.items()}
    if is_dataclass(value) and not isinstance(value, type):
        texts = {name: printable(text) for name, text in vars(value).items() if isinstance(text, str)}
        return replace(value, **texts) if texts else value
    return type(value)(map(_printable_texts, value)) if type(value) in (list, tuple) else value


class Record(BaseModel):
    """Base of every record: unknown fields and numbers not finite raise, texts become `printable`."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    _printable = field_validator("*", mode="before")(_printable_texts)


@cache
def installed_versions() -> dict[str, str]:
    """Return the versions of Python and of the numerical libraries that are installed."""
    import platform

    versions = {"python": platform.python_version()}
    for library in _LIBRARIES:
        with suppress(PackageNotFoundError):
            versions[library] = version(library)
    return versions


def write_record(path: str | Path, record: BaseModel, *, indent: int = 2) -> None:
    """Write a record as indented JSON, atomically. Raises OutputError when the folder cannot be written."""
    write_text(path, record.model_dump_json(indent=indent) + "\n")


def read_record(
    path: str | Path,
    kind: type[Content],
    *,
    what: str = "",
    advice: str = "it was edited, cut short, or written by another version: process the scan again",
    error: type[Scan2AlbedoError] = Scan2AlbedoError,
) -> Content:
    """Read and check a record, for example ``read_record("out/james/result.json", ResultRecord)``.

    Messages call the content `what`, such as "key points"; `advice` says what to do about a file that does
    not fit. Raises `error`, naming the file and the first fault, when it is missing, no JSON, or does not
    fit, or when the publication of its folder was cut off.
    """
    place = f"{what} {path}".lstrip()
    try:
        check_whole(Path(path).parent)
    except OSError as cause:
        raise error(f"{place} cannot be read: {one_line(cause)}") from cause
    text = read_text(Path(path), what=place, advice=advice, error=error, limit=FILE_BYTES)
    return parse_record(text, kind, place=place, advice=advice, error=error)


def parse_record(
    text: str,
    kind: type[Content],
    *,
    place: str,
    advice: str,
    error: type[Scan2AlbedoError],
    whole: str = "the file",
) -> Content:
    """Return the record in JSON text that messages place in `place` and call `whole`; see `read_record`."""
    try:
        return kind.model_validate_json(text)
    except ValidationError as cause:
        first = cause.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or whole
        raise error(f"{place}: {where}: {first['msg']} ({cause.error_count()} problems); {advice}") from cause
