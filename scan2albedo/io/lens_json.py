"""Record of lenses put into a frame and shown."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from scan2albedo.io.result_json import Figures, InputRecord, Number, Record

_SHA256 = "^[0-9a-f]{64}$"
_Vector = tuple[Number, Number, Number]


class FileRecord(Record):
    """A file that was read."""

    file: str = Field(description="Path as given.")
    sha256: str = Field(pattern=_SHA256)


class LensRecord(Record):
    """One lens: what it is made of, and the rim it fills."""

    side: Literal["left", "right"] = Field(description="The wearer's.")
    dioptres: Number = Field(description="1/m; negative for the shortsighted.")
    tint_linear: _Vector
    alpha: Number = Field(ge=0, le=1, description="Share of the tint.")
    beta: Number = Field(ge=0, le=1, description="Share of the reflection, at right angles.")
    fresnel: bool
    tinting: Literal["paint", "filter"]
    front_radius_mm: Number | None = Field(description="Of the sphere that mirrors; null is a flat one.")
    center_mm: _Vector = Field(description="Optical centre, in the world.")
    normal: _Vector = Field(description="Of the lens plane, towards the viewer.")
    mean_radius_mm: Number = Field(gt=0)
    measured: Number = Field(
        ge=0, le=1, description="Share of the outline met by rays; the rest is filled in."
    )
    gaps: Literal["none", "interpolated", "subdivided"] = Field(description="How the rest was filled in.")


class LensViewRecord(Record):
    """One picture."""

    name: str = Field(min_length=1)
    width: int = Field(ge=1)
    height: int = Field(ge=1)
    left_lens_pixels: int = Field(ge=0)
    right_lens_pixels: int = Field(ge=0)
    unknown_pixels: int = Field(ge=0, description="Of which the photograph does not show what a lens does.")
    seconds: Number = Field(ge=0)


class LensesRecord(Record):
    """The content of `result.json`."""

    format_version: Literal[1] = 1
    scan2albedo_version: str
    versions: dict[str, str] = Field(description="Of Python and the numerical libraries.")
    name: str = Field(min_length=1, description="Name of the frame.")
    options: Figures = Field(description="Settings of the pictures.")
    input: InputRecord = Field(description="The frame.")
    keypoints: FileRecord
    mm_per_unit: Number = Field(gt=0, description="Of the frame's file.")
    head: InputRecord
    cameras: FileRecord
    pictures: tuple[FileRecord, ...] = ()
    environment: FileRecord | None = Field(None, description="null for the built-in one, or none.")
    light: Literal["given", "built-in", "none"] = Field(description="Where the environment comes from.")
    exposure: Number = Field(gt=0, description="Factor on linear colours in the PNG files.")
    lenses: tuple[LensRecord, ...]
    views: tuple[LensViewRecord, ...] = Field(min_length=1)
    notes: tuple[str, ...] = ()
    files: tuple[str, ...] = Field(description="Names of the files beside this one.")
