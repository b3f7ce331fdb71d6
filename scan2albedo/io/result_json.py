"""`result.json` and `registration.json`: what one run did, as checked records with JSON Schemas."""

from __future__ import annotations

import math
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, JsonValue

from scan2albedo.errors import Scan2AlbedoError
from scan2albedo.io.atomic import write_text
from scan2albedo.io.checked_json import checked_content

if TYPE_CHECKING:
    from scan2albedo.core.point_light import PointLight

_LIBRARIES = ("numpy", "scipy", "numba", "libigl", "open3d-cpu", "open3d", "embreex", "xatlas", "trimesh")

RecordType = TypeVar("RecordType", bound="Record")


def plain_json(value: Any) -> Any:
    """Return a value in JSON's own types: numpy unwrapped, paths as text, NaN and infinity as null.

    Examples
    --------
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
    return str(value) if isinstance(value, Path) else value


Figures = Annotated[dict[str, JsonValue], BeforeValidator(plain_json)]
Number = Annotated[float, BeforeValidator(plain_json)]
OptionalNumber = Annotated[float | None, BeforeValidator(plain_json)]
Row = tuple[float, float, float, float]
Matrix = Annotated[tuple[Row, Row, Row, Row], BeforeValidator(plain_json)]


class Record(BaseModel):
    """Base of every record: unknown fields are refused, values are fixed, numbers are finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class InputRecord(Record):
    """The scan a result was made from."""

    file: str | None = Field(None, description="Path as given; null when the scan came from memory.")
    sha256: str = Field(
        pattern="^[0-9a-f]{64}$", description="Of the scan file and the files it refers to; see input_sha256."
    )
    vertices: int = Field(ge=1, description="After repairs.")
    faces: int = Field(ge=1, description="After repairs.")
    texture_size: tuple[int, int] | None = Field(None, description="Width and height in texels.")


class PlanRecord(Record):
    """One decision: a step that ran or was left out."""

    stage: str
    ran: bool
    reason: str
    evidence: str = Field("", description="The measured figure behind the reason, with its unit.")


class LightRecord(Record):
    """One light in the model's frame."""

    azimuth_deg: Number = Field(description="From +z toward +x.")
    elevation_deg: Number = Field(description="From the xz-plane toward +y.")
    distance_mm: OptionalNumber = Field(None, description="From the model's origin; null is a distant light.")
    intensity: Number = Field(ge=0, description="Irradiance relative to ambient = 1.")

    @classmethod
    def of(cls, light: PointLight) -> LightRecord:
        """Return the record of a light."""
        return cls(
            azimuth_deg=math.degrees(light.azimuth_rad),
            elevation_deg=math.degrees(light.elevation_rad),
            distance_mm=light.distance_mm,
            intensity=light.intensity,
        )


class ResultRecord(Record):
    """The content of `result.json`."""

    format_version: Literal[1] = 1
    scan2albedo_version: str
    versions: dict[str, str] = Field(description="Of Python and the numerical libraries.")
    name: str = Field(min_length=1, description="Name of the scan.")
    seed: int
    options: Figures = Field(description="What the run was called with.")
    input: InputRecord
    plan: tuple[PlanRecord, ...]
    metrics: Figures = Field(description="Figures of each stage; null is not finite or not measured.")
    lights: tuple[LightRecord, ...] = ()
    parameters: Figures = Field(
        description="Of the reflectance model; null is infinite, as a light's distance."
    )
    timings_s: dict[str, Number] = Field(description="Wall-clock seconds of each stage.")
    notes: tuple[str, ...] = Field((), description="What loading repaired, and warnings of the stages.")
    files: tuple[str, ...] = Field((), description="Names of the files beside this one.")


class RegistrationRecord(Record):
    """The content of `registration.json`."""

    format_version: Literal[1] = 1
    model_from_scan: Matrix = Field(
        description="Row-major 4x4 acting on column vectors: scan points in mm into the model's frame."
    )
    fitted_from_scan: Matrix | None = Field(
        None, description="The same as the fit refined it: into the frame of fitted.glb."
    )
    rmse_mm: Number = Field(ge=0)
    depth_error: OptionalNumber = Field(
        None, description="Depth-derivative objective; null when not measured."
    )
    converged: bool
    confidence: Number = Field(ge=0, le=1)
    iterations: int = Field(ge=0)


def installed_versions() -> dict[str, str]:
    """Return the versions of Python and of the numerical libraries that are installed."""
    import platform

    versions = {"python": platform.python_version()}
    for library in _LIBRARIES:
        try:
            versions[library] = version(library)
        except PackageNotFoundError:
            continue
    return versions


def write_record(path: str | Path, record: Record) -> None:
    """Write a record as indented JSON, atomically.

    Parameters
    ----------
    path : str or Path
    record : Record

    Raises
    ------
    OutputError
        When the folder cannot be written.
    """
    write_text(path, record.model_dump_json(indent=2) + "\n")


def listed_files(path: Path, kind: type[Record]) -> tuple[str, ...]:
    """Return the `files` of an older record, none when there is no such record of that kind."""
    try:
        return tuple(getattr(read_record(path, kind), "files", ()))
    except Scan2AlbedoError:
        return ()


def read_record(path: str | Path, kind: type[RecordType]) -> RecordType:
    """Read and check a record, for example ``read_record("out/james/result.json", ResultRecord)``.

    Parameters
    ----------
    path : str or Path
    kind : type of Record
        Such as `ResultRecord`.

    Returns
    -------
    the record, of type `kind`

    Raises
    ------
    Scan2AlbedoError
        When the file is missing, no JSON, or does not fit; the message names the file and the first fault.
    """
    file = Path(path)
    try:
        text = file.read_bytes()
    except OSError as error:
        raise Scan2AlbedoError(f"{file}: cannot be read: {error.strerror or error}") from error
    return checked_content(
        text,
        kind,
        place=str(file),
        advice="it was edited, cut short, or written by another version: process the scan again",
        error=Scan2AlbedoError,
    )
