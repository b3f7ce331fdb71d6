"""`photograph.json`: a picture of a face in any light, its camera, and data on the face's shape."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.errors import ReflectanceError
from scan2albedo.io.images import read_image_values
from scan2albedo.io.load_scan import read_mesh_file
from scan2albedo.io.records import read_record, write_record
from scan2albedo.io.units import MM_PER_UNIT
from scan2albedo.reflectance.shape_model import LANDMARKS

_Row = tuple[float, float, float, float]
_Pixel = tuple[float, float]


class FacePhotographFile(BaseModel):
    """The content of a photograph file."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, allow_inf_nan=False, title="scan2albedo face photograph"
    )

    format: Literal["scan2albedo face photograph"] = "scan2albedo face photograph"
    format_version: Literal[1] = 1
    unit: Literal["mm", "cm", "m"] = "mm"
    image: str = Field(description="Relative to this file.")
    mask: str | None = Field(None, description="Image, bright on skin; null: no mask. Relative to this file.")
    gamma: float = Field(1.2, ge=0.1, le=10, description="Light is value^gamma.")
    saturation: float = Field(0.98, gt=0, description="Values from here on may be clipped.")
    camera: tuple[_Row, _Row, _Row] = Field(
        description="Row-major 3x4: pixels (column, row), centres at integers, from points in `unit`."
    )
    mesh: str | None = Field(
        None,
        description="The face in the camera's frame: OBJ, PLY, GLB, STL or OFF with the model's vertices in "
        "their order; null when landmarks give the shape. Relative to this file.",
    )
    landmarks: tuple[_Pixel | None, ...] | None = Field(
        None, description="68 pixels (column, row), iBUG-68 order; null for what is hidden."
    )

    @model_validator(mode="after")
    def _complete(self) -> FacePhotographFile:
        if self.mesh is None and self.landmarks is None:
            raise ValueError("there is neither a mesh nor landmarks; give one of them")
        if self.landmarks is not None and len(self.landmarks) != LANDMARKS:
            raise ValueError(f"there are {len(self.landmarks)} landmarks, expected {LANDMARKS}")
        return self


@dataclass(frozen=True)
class PhotographFiles:
    """The content of a photograph file, with its image, mask and mesh."""

    path: Path
    """Of the file."""
    content: FacePhotographFile
    """What the file holds, in its own unit."""
    image: NDArray[np.generic]
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

    @property
    def gamma_given(self) -> bool:
        """Whether the file says what gamma is, which is a guess otherwise."""
        return "gamma" in self.content.model_fields_set


def read_photograph(path: str | Path) -> PhotographFiles:
    """Return what a photograph file says, with its image, mask and mesh.

    Raises `ReflectanceError` when the file is invalid, or mask and image differ in size; names it and the
    first fault; `ScanError` when image, mask or mesh cannot be read.
    """
    file = Path(path)
    content = read_record(
        file,
        FacePhotographFile,
        what="photograph",
        advice="give a file that write_photograph wrote (data_schemas/face_photograph.schema.json)",
        error=ReflectanceError,
    )
    scale, folder = MM_PER_UNIT[content.unit], file.parent
    image = read_image_values(folder / content.image)
    camera = np.array(content.camera, np.float64)
    camera[:, :3] /= scale
    vertices, faces = None, None
    if content.mesh is not None:
        mesh = read_mesh_file(folder / content.mesh)
        vertices, faces = np.asarray(mesh.vertices, np.float64) * scale, mesh.faces
    landmarks = None
    if content.landmarks is not None:
        landmarks = np.array([pixel or (np.nan, np.nan) for pixel in content.landmarks], np.float64)
    mask = None
    if content.mask is not None:
        mask = read_skin_mask(folder / content.mask, image.shape[:2], f"photograph {file}")
    return PhotographFiles(file, content, image, mask, camera, vertices, faces, landmarks)


def write_photograph(path: str | Path, content: FacePhotographFile) -> None:
    """Write a photograph file, whole or not at all; the rest is the caller's. Raises `OutputError`."""
    write_record(path, content, indent=1)


def read_skin_mask(path: Path, shape: tuple[int, ...], whose: str) -> BoolArray:
    """Return a mask (H, W), True where its image is brighter than half of its brightest value.

    Raises `ReflectanceError` when its size is not `shape` (H, W), `ScanError` when it cannot be read.
    """
    values = read_image_values(path)
    if values.shape[:2] != shape:
        height, width = values.shape[:2]
        raise ReflectanceError(
            f"{whose}: the mask {path.name} is {width} x {height} pixels, the image {shape[1]} x {shape[0]}; "
            "all must have one size"
        )
    return np.asarray(values.max(-1) > values.max() / 2, np.bool_)
