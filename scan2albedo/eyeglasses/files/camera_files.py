"""Pinhole cameras as JSON files, and masks of glasses in their pictures as PNG files."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.errors import EyeglassesError, ScanError
from scan2albedo.eyeglasses.files.json_files import LengthUnit, read_json
from scan2albedo.io.atomic import make_folder
from scan2albedo.io.images import read_image_linear, write_png
from scan2albedo.io.records import Record, Row, write_record
from scan2albedo.io.units import MM_PER_UNIT

_SINGULAR = 1e-9
"""Volume that the three rows' unit vectors span below which a camera maps space onto a line."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera.

    Raises ValueError, naming the camera, when the name is no file name, the matrix is not finite, has another
    shape or a singular left 3x3 part, or the shape is not positive.
    """

    name: str
    """Of its picture, labels and mask."""
    matrix: FloatArray
    """(3, 4): pixels (column, row), centres at integers, from points in mm; any scale and sign."""
    shape: tuple[int, int]
    """(H, W) of its picture in pixels."""

    def __post_init__(self) -> None:
        checked_name(self.name)
        matrix = np.asarray(self.matrix, np.float64)
        if matrix.shape != (3, 4):
            raise ValueError(f"camera {self.name!r}: its matrix has shape {matrix.shape}, expected (3, 4)")
        if not np.isfinite(matrix).all():
            raise ValueError(f"camera {self.name!r}: its matrix holds numbers that are not finite")
        rows = np.linalg.norm(matrix[:, :3], axis=1)
        if not (rows.min() > 0 and abs(np.linalg.det(matrix[:, :3] / rows[:, None])) > _SINGULAR):
            raise ValueError(
                f"camera {self.name!r}: the left 3x3 part of its matrix is singular, which no pinhole camera "
                "is; give K [R | t]"
            )
        if len(self.shape) != 2 or min(self.shape) < 1:
            raise ValueError(
                f"camera {self.name!r}: its picture's shape is {self.shape}, expected (H, W) >= 1"
            )
        object.__setattr__(self, "matrix", matrix)


def checked_name(name: str) -> str:
    """Return the name of a camera, or raise ValueError when no file can bear it."""
    if name in ("", ".", "..") or set(name) & set('/\\:*?"<>|\0'):
        raise ValueError(f"a camera cannot be named {name!r}: its mask gets a file of that name")
    return name


def require_distinct_names(names: Iterable[str]) -> None:
    """Raise ValueError when two cameras' names are equal but for case: their files would be one."""
    seen: set[str] = set()
    for name in names:
        if name.casefold() in seen:
            raise ValueError(f"two cameras are named {name!r}; give each a name of its own")
        seen.add(name.casefold())


CameraName = Annotated[str, AfterValidator(checked_name)]


class CameraEntry(BaseModel):
    """One camera of a camera file."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: CameraName = Field(min_length=1)
    width: int = Field(ge=1, description="Of the picture in pixels.")
    height: int = Field(ge=1, description="Of the picture in pixels.")
    matrix: tuple[Row, Row, Row] = Field(
        description="Row-major 3x4: pixels (column, row), centres of pixels at integers, from points."
    )

    @model_validator(mode="after")
    def _usable(self) -> CameraEntry:
        self.camera(1.0)
        return self

    def camera(self, mm_per_unit: float) -> Camera:
        """Return the camera that takes points in mm."""
        matrix = np.array(self.matrix, np.float64)
        matrix[:, :3] /= mm_per_unit
        return Camera(self.name, matrix, (self.height, self.width))


class CamerasFile(Record):
    """The content of a camera file."""

    format: Literal["scan2albedo cameras"] = "scan2albedo cameras"
    format_version: Literal[1] = 1
    unit: LengthUnit = Field(description="Of the points that the matrices take.")
    cameras: tuple[CameraEntry, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _names_differ(self) -> CamerasFile:
        require_distinct_names(camera.name for camera in self.cameras)
        return self


def write_cameras(path: str | Path, cameras: Sequence[Camera], unit: LengthUnit = "mm") -> None:
    """Write cameras as JSON.

    Raises ValueError when there is none, or two share a name; OutputError when the file cannot be written.

    Parameters
    ----------
    path : str or Path
    cameras : sequence of Camera
    unit : {"mm", "cm", "m"}
        Of the points that the matrices in the file take.
    """
    entries = []
    for camera in cameras:
        matrix = camera.matrix.copy()
        matrix[:, :3] *= MM_PER_UNIT[unit]
        height, width = (int(side) for side in camera.shape)
        entries.append(CameraEntry(name=camera.name, width=width, height=height, matrix=matrix.tolist()))
    write_record(path, CamerasFile(unit=unit, cameras=tuple(entries)))


def read_cameras(path: str | Path) -> tuple[Camera, ...]:
    """Return the cameras of a file, for points in mm whatever the file's unit.

    Raises EyeglassesError, naming file and camera, when the file cannot be read, is no camera file, or a
    matrix is not finite or singular.

    Parameters
    ----------
    path : str or Path
    """
    content = read_json(path, CamerasFile, "cameras", writer="write_cameras", schema="cameras")
    return tuple(entry.camera(MM_PER_UNIT[content.unit]) for entry in content.cameras)


def mask_path(folder: str | Path, camera: Camera) -> Path:
    """Return where the mask of a camera lies: ``folder / "<camera>.png"``."""
    return Path(folder) / f"{camera.name}.png"


def write_masks(folder: str | Path, masks: Sequence[NDArray[np.generic]], cameras: Sequence[Camera]) -> None:
    """Write masks (H, W), nonzero where glasses are, as black and white PNGs into a folder.

    Parameters
    ----------
    folder : str or Path
    masks : sequence of (H, W) arrays
        One a camera.
    cameras : sequence of Camera
        They name the files.

    Raises
    ------
    ValueError
        When there are not as many masks as cameras, or a mask has another shape than its camera's picture.
    OutputError
        When the folder cannot be written.
    """
    if len(masks) != len(cameras):
        raise ValueError(f"there are {len(masks)} masks for {len(cameras)} cameras")
    for mask, camera in zip(masks, cameras, strict=True):
        if np.shape(mask) != camera.shape:
            raise ValueError(
                f"the mask of {camera.name!r} has shape {np.shape(mask)}, expected {camera.shape}"
            )
    make_folder(folder)
    for mask, camera in zip(masks, cameras, strict=True):
        write_png(mask_path(folder, camera), np.asarray(mask) != 0)


def read_masks(folder: str | Path, cameras: Sequence[Camera]) -> tuple[BoolArray, ...]:
    """Return a mask (H, W) a camera, True where any channel of its PNG is not zero.

    Raises EyeglassesError, naming the file, when a mask is missing, no picture, or not as large as its
    camera's.

    Parameters
    ----------
    folder : str or Path
        With a file ``<camera>.png`` for each camera.
    cameras : sequence of Camera
    """
    return tuple(_read_mask(mask_path(folder, camera), camera) for camera in cameras)


def _read_mask(path: Path, camera: Camera) -> BoolArray:
    if not path.is_file():
        raise EyeglassesError(f"mask {path} is missing; give a PNG for each camera, named after it")
    try:
        mask: BoolArray = (read_image_linear(path) != 0).any(-1)
    except ScanError as error:
        raise EyeglassesError(f"mask {path}: {error}") from error
    if mask.shape != camera.shape:
        (height, width), (wanted_height, wanted_width) = mask.shape, camera.shape
        raise EyeglassesError(
            f"mask {path} is {width} x {height} pixels, its camera's picture {wanted_width} x "
            f"{wanted_height}; give the mask of that picture"
        )
    return mask
