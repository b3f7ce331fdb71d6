"""Pinhole cameras, labels of key points in their pictures, and masks of glasses, as files."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from scan2albedo.core.arrays import (
    ArrayLike,
    BoolArray,
    FloatArray,
    GridShape,
    NDArray,
    Texts,
    checked_array,
    norms,
)
from scan2albedo.errors import EyeglassesError, ScanError, errors_of
from scan2albedo.eyeglasses.frame_files import (
    KeyPointName,
    LengthUnit,
    known_key_points,
    named_points,
    read_json,
)
from scan2albedo.eyeglasses.keypoints import KEY_POINT_COUNT, KEY_POINT_NAMES
from scan2albedo.io.atomic import make_folder
from scan2albedo.io.images import read_image_linear, write_png
from scan2albedo.io.records import PositiveCount, Record, Row, write_record
from scan2albedo.io.units import MM_PER_UNIT


@dataclass(frozen=True)
class Camera:
    """A pinhole camera: `name` and `shape` (H, W) of its picture, which labels and mask share.

    Raises ValueError, naming it, when its name, matrix or shape is not usable.
    """

    name: str
    matrix: FloatArray
    """(3, 4): pixels (column, row), centres at integers, from points in mm; any scale and sign."""
    shape: GridShape

    def __post_init__(self) -> None:
        checked_name(self.name)
        matrix = checked_array(self.matrix, (3, 4), f"camera {self.name!r}: its matrix", finite=ValueError)
        rows = norms(matrix[:, :3])
        # The volume that the rows' unit vectors span: 0 where space is mapped onto a line.
        if not (rows.min() > 0 and abs(np.linalg.det(matrix[:, :3] / rows[:, None])) > 1e-9):
            raise ValueError(f"camera {self.name!r}: its matrix's left 3x3 part is singular; give K [R | t]")
        if len(self.shape) != 2 or min(self.shape) < 1:
            raise ValueError(f"camera {self.name!r}: its picture's shape is {self.shape}, not (H, W) >= 1")
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


MASK_ENDINGS = (".png", "_mask.png")
"""What follows a camera's name in those of masks: somebody's own, or as `register` proposes it."""
CameraName = Annotated[str, AfterValidator(checked_name)]
_Labels = Annotated[dict[KeyPointName, tuple[float, float] | None], AfterValidator(known_key_points)]


class CameraEntry(BaseModel):
    """One camera of a camera file."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: CameraName = Field(min_length=1)
    width: PositiveCount = Field(description="Of the picture in pixels.")
    height: PositiveCount = Field(description="Of the picture in pixels.")
    matrix: tuple[Row, Row, Row] = Field(
        description="Row-major 3x4: pixels (column, row), centres of pixels at integers, from points."
    )

    @model_validator(mode="after")
    def _usable(self) -> Self:
        self.camera(1.0)
        return self

    def camera(self, mm_per_unit: float) -> Camera:
        """Return the camera that takes points in mm."""
        matrix = np.array(self.matrix, float)
        matrix[:, :3] /= mm_per_unit
        return Camera(self.name, matrix, (self.height, self.width))


class CamerasFile(Record):
    """The content of a camera file."""

    format: Literal["scan2albedo cameras"] = "scan2albedo cameras"
    format_version: Literal[1] = 1
    unit: LengthUnit = Field(description="Of the points that the matrices take.")
    cameras: tuple[CameraEntry, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _names_differ(self) -> Self:
        require_distinct_names(camera.name for camera in self.cameras)
        return self


def write_cameras(path: str | Path, cameras: Sequence[Camera], unit: LengthUnit = "mm") -> None:
    """Write cameras as JSON; the matrices in the file take points in `unit`.

    Raises ValueError when there is none, or two share a name; OutputError when the file cannot be written.

    Parameters
    ----------
    path, cameras, unit
    """
    entries = []
    for camera in cameras:
        matrix = camera.matrix.copy()
        matrix[:, :3] *= MM_PER_UNIT[unit]
        height, width = (int(side) for side in camera.shape)
        entries.append(CameraEntry(name=camera.name, width=width, height=height, matrix=matrix.tolist()))
    write_record(path, CamerasFile(unit=unit, cameras=tuple(entries)))


def read_cameras(path: str | Path) -> tuple[Camera, ...]:
    """Return the cameras of the file at `path`, for points in mm whatever the file's unit.

    Raises EyeglassesError, naming file and camera, when it cannot be read or a matrix is not usable.
    """
    content = read_json(path, CamerasFile, "cameras", writer="write_cameras", schema="cameras")
    return tuple(entry.camera(MM_PER_UNIT[content.unit]) for entry in content.cameras)


def write_masks(folder: str | Path, masks: Sequence[NDArray], cameras: Sequence[Camera]) -> None:
    """Write masks (H, W), one a camera, nonzero where glasses are, as ``folder / "<camera>.png"``.

    Raises ValueError when masks do not fit the cameras, OutputError when the folder cannot be written.

    Parameters
    ----------
    folder, masks, cameras
    """
    if len(masks) != len(cameras):
        raise ValueError(f"there are {len(masks)} masks for {len(cameras)} cameras")
    for mask, view in zip(masks, cameras, strict=True):
        if np.shape(mask) != view.shape:
            raise ValueError(f"the mask of {view.name!r} has shape {np.shape(mask)}, expected {view.shape}")
    make_folder(folder)
    for mask, camera in zip(masks, cameras, strict=True):
        write_png(Path(folder) / f"{camera.name}.png", np.asarray(mask) != 0)


def read_masks(folder: str | Path, cameras: Sequence[Camera]) -> tuple[BoolArray, ...]:
    """Return a mask (H, W) of each of the `cameras`: where any channel of `folder`/<camera>.png is not zero.

    Without it <camera>_mask.png counts, as `register` writes it. Raises EyeglassesError when a mask, which it
    names, is missing, unreadable, or of another size.
    """
    masks = []
    for camera in cameras:
        path = file_of_camera(Path(folder), camera, MASK_ENDINGS)
        if path is None:
            missing = Path(folder) / f"{camera.name}{MASK_ENDINGS[0]}"
            raise EyeglassesError(f"mask {missing} is missing; give a PNG for each camera, named after it")
        with errors_of(f"mask {path}", EyeglassesError, ScanError):
            mask: BoolArray = (read_image_linear(path) != 0).any(-1)
        if mask.shape != camera.shape:
            here, wanted = (f"{width} x {height}" for height, width in (mask.shape, camera.shape))
            said = f"is {here} pixels, its camera's picture {wanted}"
            raise EyeglassesError(f"mask {path} {said}; give its mask")
        masks.append(mask)
    return tuple(masks)


def file_of_camera(folder: Path, camera: Camera, endings: Texts) -> Path | None:
    """Return the first file there is of those named after a camera, with one of the endings."""
    candidates = (folder / f"{camera.name}{ending}" for ending in endings)
    return next(filter(Path.is_file, candidates), None)


@dataclass(frozen=True)
class ViewLabels:
    """Labels: `pixels` (C, 20, 2), column and row in the views of `camera_names`, NaN for missing ones."""

    camera_names: Texts
    pixels: FloatArray

    def of_cameras(self, names: Sequence[str]) -> FloatArray:
        """Return (N, 20, 2) labels of the cameras `names`, in their order; NaN for one without labels.

        Raises EyeglassesError when there are labels of a camera that is not among them.
        """
        if strange := sorted(set(self.camera_names) - set(names)):
            said = f"there are labels of a camera {strange[0]!r}, but the cameras are {', '.join(names)}"
            raise EyeglassesError(f"{said}; add it to them, or take its labels out")
        at = {name: i for i, name in enumerate(self.camera_names)}
        nothing = np.full((KEY_POINT_COUNT, 2), np.nan)
        return np.array([self.pixels[at[name]] if name in at else nothing for name in names])


class LabelsFile(Record):
    """The content of a label file."""

    format: Literal["scan2albedo eyeglasses labels"] = "scan2albedo eyeglasses labels"
    format_version: Literal[1] = 1
    views: dict[CameraName, _Labels] = Field(
        description="Pixels (column, row) by camera and key point, centres of pixels at integers; null, or "
        "no entry, where a key point is not labelled."
    )

    @model_validator(mode="after")
    def _cameras_differ(self) -> Self:
        require_distinct_names(self.views)
        return self


def write_labels(path: str | Path, labels: ArrayLike, camera_names: Sequence[str]) -> None:
    """Write labels (C, 20, 2), column and row in pixels, of C cameras as JSON; NaN as null.

    Raises ValueError for another shape, or two cameras of one name, OutputError when writing fails.

    Parameters
    ----------
    path, labels, camera_names
    """
    pixels = checked_array(labels, (len(camera_names), KEY_POINT_COUNT, 2), "labels")
    require_distinct_names(camera_names)
    views = {name: named_points(view) for name, view in zip(camera_names, pixels, strict=True)}
    write_record(path, LabelsFile(views=views))


def read_labels(path: str | Path) -> ViewLabels:
    """Return the labels of the file at `path`, NaN where one is missing.

    Raises EyeglassesError, naming the file and its first fault, when it cannot be read or is no label file.
    """
    content = read_json(path, LabelsFile, "labels", writer="write_labels", schema="eyeglasses_labels")
    nothing = (np.nan, np.nan)
    pixels = [[view.get(name) or nothing for name in KEY_POINT_NAMES] for view in content.views.values()]
    shape = (len(content.views), KEY_POINT_COUNT, 2)
    return ViewLabels(tuple(content.views), np.array(pixels, float).reshape(shape))
