"""Records of eyeglasses: frames made canonical, alone and in sets, and frames registered on faces."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from scan2albedo.io.result_json import (
    Figures,
    InputRecord,
    Matrix,
    Number,
    OptionalNumber,
    PlanRecord,
    Record,
)

_SHA256 = "^[0-9a-f]{64}$"


class CanonicalFrameRecord(Record):
    """The content of a canonical frame's `result.json`."""

    format_version: Literal[1] = 1
    scan2albedo_version: str
    versions: dict[str, str] = Field(description="Of Python and the numerical libraries.")
    name: str = Field(min_length=1, description="Name of the frame.")
    input: InputRecord
    keypoints_file: str = Field(description="Path as given.")
    keypoints_sha256: str = Field(pattern=_SHA256)
    mm_per_unit: Number = Field(gt=0, description="Of the mesh's file.")
    scale: Number = Field(gt=0, description="Factor on the frame in mm; 1 unless it was of no true size.")
    canonical_from_frame: Matrix = Field(
        description="Row-major 4x4 acting on column vectors: the frame in mm, scaled, into canonical space; "
        "rigid. The bend is taken out after it, by the key points."
    )
    converged: bool = Field(description="Whether the weights did.")
    missing_key_points: tuple[str, ...] = ()
    plan: tuple[PlanRecord, ...]
    metrics: Figures
    notes: tuple[str, ...] = Field((), description="What loading decided and repaired.")
    files: tuple[str, ...] = Field(description="Names of the files beside this one.")


class FailedFrameRecord(Record):
    """A frame that could not be done."""

    file: str = Field(description="Path as given.")
    reason: str


class CanonicalSetRecord(Record):
    """The content of a set's `set.json`."""

    format_version: Literal[1] = 1
    scan2albedo_version: str
    versions: dict[str, str] = Field(description="Of Python and the numerical libraries.")
    options: Figures = Field(description="What the run was called with.")
    frames: tuple[str, ...] = Field(description="Folders of the frames that were done.")
    failures: tuple[FailedFrameRecord, ...] = ()
    converged: bool
    iterations: int = Field(ge=0, description="Rounds of the mean; 0 when it was given.")
    seconds: Number = Field(ge=0)
    plan: tuple[PlanRecord, ...]
    files: tuple[str, ...] = Field(description="Names of the files beside this one.")


class FileRecord(Record):
    """A file that a result was made from."""

    file: str = Field(description="Path as given.")
    sha256: str = Field(pattern=_SHA256, description="Of a mesh: with the files it refers to.")


class RegisteredViewRecord(Record):
    """How well a registered frame fits one picture."""

    camera: str
    labels: int = Field(ge=0, description="Key points labelled.")
    outliers: int = Field(ge=0, description="Labels farther off than three times their noise.")
    label_rms_px: OptionalNumber = Field(None, description="Of the labels that are no outliers.")
    mask: bool = Field(description="Whether there was one.")
    outline_rms_px: OptionalNumber = Field(None, description="Where outline and mask can be compared.")
    iou: OptionalNumber = Field(
        None, description="Of the frame's mask and the given one; high values are no evidence in space."
    )
    visible_share: Number = Field(ge=0, le=1, description="Vertices in the picture and not behind the head.")


class RegisteredFrameRecord(Record):
    """The content of a registered frame's `result.json`."""

    format_version: Literal[1] = 1
    scan2albedo_version: str
    versions: dict[str, str] = Field(description="Of Python and the numerical libraries.")
    name: str = Field(min_length=1, description="Name of the frame.")
    options: Figures = Field(description="What the run was called with.")
    inputs: dict[str, FileRecord] = Field(description="By what they are: mesh, cameras, labels and others.")
    mm_per_unit: Number = Field(gt=0, description="Of the mesh's file.")
    world_from_glasses: Matrix = Field(
        description="Row-major 4x4 acting on column vectors: the frame in mm, as it was before it was bent, "
        "into the cameras' world; rigid."
    )
    converged: bool
    iterations: int = Field(ge=0, description="Evaluations of the objective.")
    seconds: Number = Field(ge=0)
    depth_observed: bool
    unobserved: tuple[str, ...] = Field(description="'depth', and key points that no picture tells.")
    views: tuple[RegisteredViewRecord, ...]
    plan: tuple[PlanRecord, ...]
    metrics: Figures
    notes: tuple[str, ...] = Field((), description="What reading decided, repaired and did not find.")
    files: tuple[str, ...] = Field(description="Names of the files beside this one.")
