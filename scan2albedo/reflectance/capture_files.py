"""`capture.json`: which pictures were taken, from where, lit by which flash, of which mesh."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.errors import ReflectanceError, ScanError
from scan2albedo.io.images import read_image_values
from scan2albedo.io.load_scan import read_mesh_file
from scan2albedo.io.records import read_record, write_record
from scan2albedo.io.units import MM_PER_UNIT
from scan2albedo.reflectance.capture_rig import CaptureRig, rig_of_head_poses
from scan2albedo.reflectance.olat import OlatImages, OlatOptions, extract_olat
from scan2albedo.reflectance.photograph_files import read_skin_mask

_SIGMAS = 6.0
"""Brighter than noise, of millions of pixels."""
Row = tuple[float, float, float]
Matrix = tuple[Row, Row, Row]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class PoseEntry(_Part):
    """Pose of the head before one camera: x_cam = R x + t. The flash of the same name is at that camera."""

    name: str = Field(min_length=1)
    rotation: Matrix = Field(description="R, row-major, proper.")
    translation: Row = Field(description="t, in `unit`.")
    intrinsics: Matrix | None = Field(None, description="Of this camera, instead of the common ones.")
    mask: str | None = Field(
        None,
        description="Image, bright where this camera sees skin; null: no mask. Relative to this file.",
    )


class PairEntry(_Part):
    """Two pictures of one camera."""

    camera: str = Field(description="Name of the pose from which they were taken.")
    flash: str = Field(description="Name of the pose where the flash stood.")
    flash_image: str = Field(description="With the flash; relative to this file.")
    room_image: str = Field(description="In the room's light alone; may be the same for several pairs.")


class FlashCaptureFile(_Part):
    """The content of a capture file."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, allow_inf_nan=False, title="scan2albedo flash capture"
    )

    format: Literal["scan2albedo flash capture"] = "scan2albedo flash capture"
    format_version: Literal[1] = 1
    unit: Literal["mm", "cm", "m"] = "mm"
    mesh: str = Field(
        description="OBJ, PLY, GLB, STL or OFF; relative to this file; vertices keep their order."
    )
    gamma: float = Field(
        1.2,
        ge=0.1,
        le=10,
        description="Light is value^gamma: 1 for linear pictures, about 2.2 for sRGB. Say it: 1.2 is that of "
        "one known rig.",
    )
    noise: float = Field(0.01, ge=1e-6, le=1, description="Standard deviation of the values, white = 1.")
    saturation: float = Field(0.98, gt=0, description="Values from here on may be clipped.")
    falloff_distance: float | None = Field(
        None, gt=0, description="Flashes fall off with the square of their distance, to 1 here; null: not."
    )
    flash_strength: float = Field(
        1.0,
        ge=1e-9,
        le=1e9,
        description="Light of value 1 comes of reflectance 1 / this; 1 leaves the scale unknown.",
    )
    intrinsics: Matrix | None = Field(
        None, description="Pixels (column, row), centres at integers, from camera coordinates."
    )
    poses: tuple[PoseEntry, ...] = Field(min_length=1)
    pictures: tuple[PairEntry, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _complete(self) -> FlashCaptureFile:
        names = [pose.name for pose in self.poses]
        if len(set(names)) < len(names):
            raise ValueError("two poses have one name; give each a name of its own")
        for number, pair in enumerate(self.pictures):
            for key in ("camera", "flash"):
                if getattr(pair, key) not in names:
                    raise ValueError(
                        f"pictures.{number}: its {key} {getattr(pair, key)!r} is not the name of a pose"
                    )
        seen = [(pair.camera, pair.flash, pair.flash_image) for pair in self.pictures]
        if len(set(seen)) < len(seen):
            twice = next(pair for pair in seen if seen.count(pair) > 1)
            raise ValueError(f"{twice[2]} is listed twice for {twice[0]} lit by {twice[1]}; list it once")
        lacking = [pose.name for pose in self.poses if (pose.intrinsics or self.intrinsics) is None]
        if lacking:
            raise ValueError(f"pose {lacking[0]!r} has no intrinsics; give them there or for all")
        return self


@dataclass(frozen=True)
class CaptureFiles:
    """The content of a capture file; pictures are read when they are needed."""

    path: Path
    """Of the file."""
    content: FlashCaptureFile
    """What the file holds, in its own unit."""
    rig: CaptureRig
    """Millimetres."""
    vertices: FloatArray
    faces: IntArray
    """`vertices`, `faces`: (V, 3), (F, 3): of the mesh, mm."""

    @property
    def reference_distance_mm(self) -> float | None:
        """Where the flashes have fallen off to 1, None when they do not fall off."""
        distance = self.content.falloff_distance
        return None if distance is None else distance * MM_PER_UNIT[self.content.unit]

    @property
    def scale_known(self) -> bool:
        """Whether the file gives the strength of the flashes, so that albedos have their true scale."""
        return self.content.flash_strength != FlashCaptureFile.model_fields["flash_strength"].default

    @property
    def gamma_given(self) -> bool:
        """Whether the file says what gamma is, which is a guess otherwise."""
        return "gamma" in self.content.model_fields_set

    def pair_names(self) -> tuple[str, ...]:
        """Return camera and flash of each pair."""
        return tuple(f"{pair.camera} lit by {pair.flash}" for pair in self.content.pictures)

    def extract_olat(self) -> OlatImages:
        """Read the pictures and subtract the room's light; pixels without skin are not valid.

        Raises `ScanError`, naming the picture, when one is missing or damaged, `ReflectanceError` as
        `reflectance.extract_olat`, when pictures differ in size, and when flashes add nothing.
        """
        content, whose = self.content, f"capture {self.path}"
        read = cache(lambda name: read_image_values(self.path.parent / name))
        flashes = [read_image_values(self.path.parent / pair.flash_image) for pair in content.pictures]
        rooms = [read(pair.room_image) for pair in content.pictures]
        first = flashes[0].shape[:2]
        for pair, lit, ambient in zip(content.pictures, flashes, rooms, strict=True):
            for name, picture in ((pair.flash_image, lit), (pair.room_image, ambient)):
                if picture.shape[:2] != first:
                    height, width = picture.shape[:2]
                    raise ReflectanceError(
                        f"{whose}: {name} is {width} x {height} pixels and "
                        f"{content.pictures[0].flash_image} {first[1]} x {first[0]}; all must have one size"
                    )
        options = OlatOptions(gamma=content.gamma, noise=content.noise, saturation=content.saturation)
        olat = extract_olat(flashes, rooms, options=options)
        mask_of, valid = {pose.name: pose.mask for pose in content.poses}, olat.valid
        mask = cache(lambda name: read_skin_mask(self.path.parent / name, first, whose))
        for j, pair in enumerate(content.pictures):
            if (skin := mask_of[pair.camera]) is not None:
                valid[j] &= mask(skin)[..., None]
        olat = replace(olat, linear=np.where(valid, olat.linear, np.float32(0)))
        if valid.any() and not (olat.linear > _SIGMAS * olat.sigma).any(where=valid):
            raise ReflectanceError(
                f"{whose}: no pixel of any pair is brighter with its flash by more than noise: did the "
                "flashes fire, do the names of the files say so, is `noise` right?"
            )
        return olat


def read_capture(path: str | Path) -> CaptureFiles:
    """Return what a capture file says, and its mesh; no picture is read.

    Raises `ReflectanceError` when the file or a pose in it is invalid; names it and the first fault;
    `ScanError` when the mesh cannot be read.
    """
    file = Path(path)
    content = read_record(
        file,
        FlashCaptureFile,
        what="capture",
        advice="give a file that write_capture wrote (data_schemas/flash_capture.schema.json)",
        error=ReflectanceError,
    )
    mesh = read_mesh_file(file.parent / content.mesh)
    if not len(mesh.faces):
        raise ScanError(f"{file.parent / content.mesh}: holds no triangles; export the mesh again")
    scale, number = MM_PER_UNIT[content.unit], {pose.name: k for k, pose in enumerate(content.poses)}
    common = content.intrinsics
    try:
        rig = rig_of_head_poses(
            [pose.rotation for pose in content.poses],
            [np.multiply(pose.translation, scale) for pose in content.poses],
            np.array([pose.intrinsics or common for pose in content.poses], np.float64),
            view=[number[pair.camera] for pair in content.pictures],
            flash=[number[pair.flash] for pair in content.pictures],
        )
    except ReflectanceError as error:
        raise ReflectanceError(f"capture {file}: {error}") from error
    return CaptureFiles(file, content, rig, np.asarray(mesh.vertices, np.float64) * scale, mesh.faces)


def write_capture(path: str | Path, content: FlashCaptureFile) -> None:
    """Write a capture file, whole or not at all; pictures and mesh are the caller's. Raises `OutputError`."""
    write_record(path, content, indent=1)
