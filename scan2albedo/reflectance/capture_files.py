"""`capture.json`, pictures of a face lit by flashes, and `photograph.json`, one in any light."""

import os
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray, NDArray, Texts
from scan2albedo.errors import ReflectanceError, ScanError, errors_of
from scan2albedo.io.images import read_image_values
from scan2albedo.io.load_scan import read_mesh_file
from scan2albedo.io.records import Name, read_record, write_record
from scan2albedo.io.units import MM_PER_UNIT
from scan2albedo.reflectance.olat import OlatImages, OlatOptions, extract_olat
from scan2albedo.reflectance.shape_model import LANDMARKS
from scan2albedo.reflectance.vertex_samples import CaptureRig, rig_of_head_poses

Row = tuple[float, float, float]
Matrix = tuple[Row, Row, Row]
_Row = tuple[float, float, float, float]
_Pixel = tuple[float, float]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class FacePhotographFile(_Part):
    """The content of a photograph file."""

    model_config = ConfigDict(title="scan2albedo face photograph")

    format: Literal["scan2albedo face photograph"] = "scan2albedo face photograph"
    format_version: Literal[1] = 1
    unit: Literal["mm", "cm", "m"] = "mm"
    image: str = Field(description="Relative to this file.")
    mask: str | None = Field(None, description="Image, bright on skin; null: no mask. Relative to this file.")
    gamma: float = Field(1.2, ge=0.1, le=10, description="Light is value^gamma.")
    saturation: float = Field(0.98, gt=0, le=1e6, description="Values from here on may be clipped.")
    camera: tuple[_Row, _Row, _Row] = Field(
        description="Row-major 3x4: pixels (column, row), centres at integers, from points in `unit`."
    )
    mesh: str | None = Field(
        None,
        description="The face in the camera's frame: OBJ, PLY, GLB (metres), STL or OFF, or the folder of a "
        "processed scan (fitted.glb); null when landmarks give the shape. Relative to this file.",
    )
    landmarks: tuple[_Pixel | None, ...] | None = Field(
        None, description="68 pixels (column, row), iBUG-68 order; null for what is hidden."
    )

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if self.mesh is None and self.landmarks is None:
            raise ValueError("there is neither a mesh nor landmarks; give one of them")
        if self.landmarks is not None and len(self.landmarks) != LANDMARKS:
            raise ValueError(f"there are {len(self.landmarks)} landmarks, expected {LANDMARKS}")
        return self


@dataclass(frozen=True)
class PhotographFiles:
    """The content of a photograph file, with its image, mask and mesh."""

    path: Path
    content: FacePhotographFile
    """`path`, `content`: of the file, in its own unit."""
    image: NDArray
    """(H, W, 3) uint8, uint16 or float32: values."""
    mask: BoolArray | None
    """(H, W)."""
    camera: FloatArray
    """(3, 4): from points in mm."""
    vertices: FloatArray | None
    """(V, 3): of the mesh, mm."""
    faces: IntArray | None
    """(F, 3): of the mesh; empty for points alone."""
    landmarks_px: FloatArray | None
    """(68, 2): NaN for hidden ones."""


def read_photograph(path: str | Path) -> PhotographFiles:
    """Return what the photograph file at `path` says, with its image, mask and mesh.

    Raises `ReflectanceError` when the file is invalid, or mask and image differ in size; `ScanError` when
    image, mask or mesh cannot be read.
    """
    file = Path(path)
    content = read_record(
        file,
        FacePhotographFile,
        what="photograph",
        advice="write it as data_schemas/face_photograph.schema.json says",
        error=ReflectanceError,
    )
    scale = MM_PER_UNIT[content.unit]
    image = read_image_values(_sibling(file, content.image), upright=True)
    camera = np.array(content.camera, float)
    camera[:, :3] /= scale
    vertices, faces = None, None
    if content.mesh is not None:
        place = _sibling(file, content.mesh)
        place = place / "fitted.glb" if place.is_dir() else place
        mesh, metres = read_mesh_file(place), place.suffix.lower() in (".glb", ".gltf")  # by specification
        vertices, faces = np.asarray(mesh.vertices, float) * (1000 if metres else scale), mesh.faces
    landmarks = None
    if content.landmarks is not None:
        landmarks = np.array([pixel or (np.nan, np.nan) for pixel in content.landmarks], float)
    shape, whose = image.shape[:2], f"photograph {file}"
    mask = None if content.mask is None else read_skin_mask(_sibling(file, content.mask), shape, whose)
    return PhotographFiles(file, content, image, mask, camera, vertices, faces, landmarks)


def _sibling(file: Path, name: str) -> Path:
    """Return what a capture or photograph file names; ReflectanceError where that lies outside its folder."""
    place, folder = file.parent / name, os.path.realpath(file.parent)
    if "\0" in name or not Path(os.path.realpath(place)).is_relative_to(folder):
        raise ReflectanceError(f"{file}: {name} lies outside its folder; copy it there and name that copy")
    return place


def read_skin_mask(path: Path, shape: tuple[int, ...], whose: str) -> BoolArray:
    """Return a mask (H, W), True where its image is brighter than half of its brightest value."""
    values = read_image_values(path, upright=True)
    if values.shape[:2] != shape:
        height, width = values.shape[:2]
        raise ReflectanceError(
            f"{whose}: the mask {path.name} is {width} x {height} pixels, the image {shape[1]} x {shape[0]}; "
            "all must have one size"
        )
    return np.asarray(values.max(-1) > values.max() / 2, np.bool_)


class PoseEntry(_Part):
    """Pose of the head before one camera: x_cam = R x + t. The flash of the same name is at that camera."""

    name: Name
    rotation: Matrix = Field(description="R, row-major, proper.")
    translation: Row = Field(description="t, in `unit`.")
    intrinsics: Matrix | None = Field(None, description="Of this camera, instead of the common ones.")
    mask: str | None = Field(
        None, description="Image, bright where this camera sees skin; null: no mask. Relative to this file."
    )


class PairEntry(_Part):
    """Two pictures of one camera."""

    camera: str = Field(description="Name of the pose from which they were taken.")
    flash: str = Field(description="Name of the pose where the flash stood.")
    flash_image: str = Field(description="With the flash; relative to this file.")
    room_image: str = Field(description="In the room's light alone; may be the same for several pairs.")


class FlashCaptureFile(_Part):
    """The content of a capture file."""

    model_config = ConfigDict(title="scan2albedo flash capture")

    format: Literal["scan2albedo flash capture"] = "scan2albedo flash capture"
    format_version: Literal[1] = 1
    unit: Literal["mm", "cm", "m"] = "mm"
    mesh: str = Field(
        description="OBJ, PLY, GLB, STL, OFF; relative to this file; vertices keep their order."
    )
    gamma: float = Field(
        1.2,
        ge=0.1,
        le=10,
        description="Light is value^gamma: 1 for linear pictures, about 2.2 for sRGB. Say it: 1.2 is that of "
        "one known rig.",
    )
    noise: float = Field(0.01, ge=1e-6, le=1, description="Standard deviation of the values, white = 1.")
    saturation: float = Field(0.98, gt=0, le=1e6, description="Values from here on may be clipped.")
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
    def _complete(self) -> Self:
        names = [pose.name for pose in self.poses]
        if len(set(names)) < len(names):
            raise ValueError("two poses have one name; give each a name of its own")
        for number, pair in enumerate(self.pictures):
            for key in ("camera", "flash"):
                if getattr(pair, key) not in names:
                    raise ValueError(f"pictures.{number}: its {key} {getattr(pair, key)!r} is no pose")
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
    content: FlashCaptureFile
    """`path`, `content`: of the file, in its own unit."""
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

    def pair_names(self) -> Texts:
        """Camera and flash of each pair."""
        return tuple(f"{pair.camera} lit by {pair.flash}" for pair in self.content.pictures)

    def extract_olat(self) -> OlatImages:
        """Read the pictures and subtract the room's light; pixels without skin are not valid.

        Raises `ScanError`, naming the picture, when one is missing or damaged, `ReflectanceError` as
        `reflectance.extract_olat`, when pictures differ in size, and when flashes add nothing.
        """
        content, whose = self.content, f"capture {self.path}"
        read = cache(lambda name: read_image_values(_sibling(self.path, name), upright=True))
        flashes = [read(pair.flash_image) for pair in content.pictures]
        rooms = [read(pair.room_image) for pair in content.pictures]
        first = flashes[0].shape[:2]
        for pair in content.pictures:
            for name in (pair.flash_image, pair.room_image):
                height, width = read(name).shape[:2]
                if (height, width) != first:
                    raise ReflectanceError(
                        f"{whose}: {name} is {width} x {height} pixels and "
                        f"{content.pictures[0].flash_image} {first[1]} x {first[0]}; all must have one size"
                    )
        options = OlatOptions(gamma=content.gamma, noise=content.noise, saturation=content.saturation)
        olat = extract_olat(flashes, rooms, options=options)
        mask_of, valid = {pose.name: pose.mask for pose in content.poses}, olat.valid
        mask = cache(lambda name: read_skin_mask(_sibling(self.path, name), first, whose))
        for j, pair in enumerate(content.pictures):
            if (skin := mask_of[pair.camera]) is not None:
                valid[j] &= mask(skin)[..., None]
        olat = replace(olat, linear=np.where(valid, olat.linear, np.float32(0)))
        # Six standard deviations are brighter than noise, of millions of pixels.
        if valid.any() and not (olat.linear > 6 * olat.sigma).any(where=valid):
            raise ReflectanceError(
                f"{whose}: no pixel of any pair is brighter with its flash by more than noise: did the "
                "flashes fire, do the names of the files say so, is `noise` right?"
            )
        return olat


def read_capture(path: str | Path) -> CaptureFiles:
    """Return what the capture file at `path` says, and its mesh; no picture is read.

    Raises `ReflectanceError` when the file or a pose in it is invalid, `ScanError` when its mesh is.
    """
    file = Path(path)
    content = read_record(
        file,
        FlashCaptureFile,
        what="capture",
        advice="give a file that write_capture wrote (data_schemas/flash_capture.schema.json)",
        error=ReflectanceError,
    )
    mesh = read_mesh_file(place := _sibling(file, content.mesh))
    if not len(mesh.faces):
        raise ScanError(f"{place}: holds no triangles; export the mesh again")
    scale, number = MM_PER_UNIT[content.unit], {pose.name: k for k, pose in enumerate(content.poses)}
    common = content.intrinsics
    with errors_of(f"capture {file}", ReflectanceError):
        rig = rig_of_head_poses(
            [pose.rotation for pose in content.poses],
            [np.multiply(pose.translation, scale) for pose in content.poses],
            np.array([pose.intrinsics or common for pose in content.poses], float),
            view=[number[pair.camera] for pair in content.pictures],
            flash=[number[pair.flash] for pair in content.pictures],
        )
    return CaptureFiles(file, content, rig, np.asarray(mesh.vertices, float) * scale, mesh.faces)


def write_capture(path: str | Path, content: FlashCaptureFile) -> None:
    """Write `content` to `path`, whole or not at all; the rest is the caller's. Raises `OutputError`."""
    write_record(path, content, indent=1)
