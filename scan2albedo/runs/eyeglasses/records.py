"""Records of eyeglasses: canonical frames, alone and in sets, frames registered on faces, and lenses."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from scan2albedo.core.plan import PlanStep
from scan2albedo.io.records import Figures, Matrix, Number, OptionalNumber, Record
from scan2albedo.io.result_records import SHA256, InputRecord, RunRecord

_Vector = tuple[Number, Number, Number]


class CanonicalFrameRecord(RunRecord):
    """The content of a canonical frame's `result.json`."""

    name: str = Field(min_length=1, description="Name of the frame.")
    input: InputRecord
    keypoints_file: str = Field(description="Path as given.")
    keypoints_sha256: str = Field(pattern=SHA256)
    mm_per_unit: Number = Field(gt=0, description="Of the mesh's file.")
    scale: Number = Field(gt=0, description="Factor on the frame in mm; 1 unless it was of no true size.")
    canonical_from_frame: Matrix = Field(
        description="Row-major 4x4 acting on column vectors: the frame in mm, scaled, into canonical space; "
        "rigid. The bend is taken out after it, by the key points."
    )
    mode: Literal["unbend", "mean"] = Field(
        description="Whether the frame keeps its own shape and sizes, or its key points are the mean's."
    )
    converged: bool = Field(description="Whether the weights did.")
    missing_key_points: tuple[str, ...] = ()
    plan: tuple[PlanStep, ...]
    metrics: Figures
    notes: tuple[str, ...] = Field((), description="What loading decided and repaired.")
    files: tuple[str, ...] = Field(description="Names of the files beside this one.")


class FailedFrameRecord(Record):
    """A frame that could not be done."""

    file: str = Field(description="Path as given.")
    reason: str


class CanonicalSetRecord(RunRecord):
    """The content of a set's `set.json`."""

    options: Figures = Field(description="What the run was called with.")
    frames: tuple[str, ...] = Field(description="Folders of the frames that were done.")
    failures: tuple[FailedFrameRecord, ...] = ()
    notes: tuple[str, ...] = Field((), description="Frames that are unlike the others, and how.")
    converged: bool
    iterations: int = Field(ge=0, description="Rounds of the mean; 0 when it was given.")
    seconds: Number = Field(ge=0)
    plan: tuple[PlanStep, ...]
    files: tuple[str, ...] = Field(description="Names of the files beside this one.")


class FileRecord(Record):
    """A file that a result was made from."""

    file: str = Field(description="Path as given.")
    sha256: str = Field(pattern=SHA256, description="Of a mesh: with the files it refers to.")


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


class RegisteredFrameRecord(RunRecord):
    """The content of a registered frame's `result.json`."""

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
    plan: tuple[PlanStep, ...]
    metrics: Figures
    notes: tuple[str, ...] = Field((), description="What reading decided, repaired and did not find.")
    files: tuple[str, ...] = Field(description="Names of the files beside this one.")


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


class LensesRecord(RunRecord):
    """The content of `result.json`."""

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
