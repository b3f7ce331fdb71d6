"""Canonical frames and registered ones as NPZ files, and poses to start from as JSON."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, model_validator

from scan2albedo.core import Plan, Trace
from scan2albedo.core.arrays import FloatArray
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.canonical.canonicalization import CanonicalEyeglasses
from scan2albedo.eyeglasses.files.json_files import LengthUnit, read_json
from scan2albedo.eyeglasses.keypoints import KEY_POINT_COUNT, KEY_POINT_NAMES, PARENTS
from scan2albedo.eyeglasses.on_face.inputs import RegisteredEyeglasses
from scan2albedo.io.npz import read_npz, write_npz
from scan2albedo.io.records import Matrix, Record, plain_json, write_record
from scan2albedo.io.skinned_glb import SkinWritten, write_skinned_glb
from scan2albedo.io.units import MM_PER_UNIT

Layout = Mapping[str, tuple[type, *tuple[int | str, ...]]]
"""Type and shape of arrays by name; a letter stands for a length that is one wherever the letter is."""
_FRAME_LAYOUT: Layout = {
    "vertices": (float, "V", 3),
    "faces": (int, "F", 3),
    "weights": (float, "V", KEY_POINT_COUNT),
    "keypoints": (float, KEY_POINT_COUNT, 3),
}
_CANONICAL_LAYOUT: Layout = {
    **_FRAME_LAYOUT,
    "canonical_from_frame": (float, 4, 4),
    "scale": (float,),
    "handle_transforms": (float, KEY_POINT_COUNT, 4, 4),
    "residual": (float,),
    "unbent": (bool,),
    "converged": (bool,),
}
_REGISTERED_LAYOUT: Layout = {
    **_FRAME_LAYOUT,
    "world_from_glasses": (float, 4, 4),
    "handle_transforms": (float, KEY_POINT_COUNT, 4, 4),
    "bend": (float, KEY_POINT_COUNT, 3),
    "visible": (bool, "C", "V"),
    "deviation": (float, "V"),
    "observed": (bool, "V"),
    "keypoint_deviation": (float, KEY_POINT_COUNT),
    "keypoints_observed": (bool, KEY_POINT_COUNT),
    "depth_deviation": (float,),
    "depth_observed": (bool,),
    "label_errors_px": (float, "C", KEY_POINT_COUNT),
    "inliers": (bool, "C", KEY_POINT_COUNT),
    "outline_rms_px": (float, "C"),
    "iou": (float, "C"),
    "converged": (bool,),
    "iterations": (int,),
}
_ROUNDED = 1e-6
"""How far from a rotation the left 3x3 part may be."""


def write_arrays(path: str | Path, source: Any, layout: Layout, *, what: str) -> None:
    """Write the attributes of `source` that `layout` names as an NPZ file, whole or not at all."""
    arrays = {name: np.asarray(getattr(source, name)) for name in layout}
    write_npz(path, arrays, what=what, compression=6)


def read_arrays(path: str | Path, layout: Layout, *, what: str, example: str) -> dict[str, Any]:
    """Return the arrays of a file in their types; a scalar as a Python number.

    `layout` holds all arrays that must be there; those of "vertices" and "faces" make a mesh. Messages call
    the content `what` and the usual file `example`. Raises EyeglassesError when the file is missing, damaged
    or something else.
    """
    arrays = read_npz(path, layout, what=what, advice=f"give a {example}", error=EyeglassesError)
    lengths: dict[str, int] = {}
    for name, (_, *shape) in layout.items():
        got = arrays[name].shape
        wanted = tuple(
            lengths.setdefault(side, got[k]) if isinstance(side, str) and k < len(got) else side
            for k, side in enumerate(shape)
        )
        if got != wanted or arrays[name].dtype.kind not in "biuf":
            raise EyeglassesError(
                f"{what} {path}: {name} has shape {got} of {arrays[name].dtype}, expected numbers of shape "
                f"({', '.join(map(str, wanted))}); write it again"
            )
    _check_mesh(arrays["vertices"], arrays["faces"], f"{what} {path}")
    return {name: _typed(arrays[name], kind) for name, (kind, *_) in layout.items()}


def _typed(array: NDArray[Any], kind: type) -> Any:
    typed: NDArray[Any] = array.astype(kind, copy=False)
    return typed if typed.ndim else typed.item()


def _check_mesh(vertices: NDArray[Any], faces: NDArray[Any], place: str) -> None:
    if not np.isfinite(vertices).all():
        raise EyeglassesError(f"{place}: vertices are not finite; write it again")
    if faces.dtype.kind not in "iu" or len(faces) == 0 or faces.min() < 0 or faces.max() >= len(vertices):
        raise EyeglassesError(f"{place}: faces are not those of its vertices; write it again")


def write_canonical(path: str | Path, frame: CanonicalEyeglasses) -> None:
    """Write a frame that `canonicalize` made, all but its plan, atomically.

    Raises ValueError when the name does not end in .npz, OutputError when the folder cannot be written.

    Parameters
    ----------
    path : str or Path
    frame : CanonicalEyeglasses
    """
    write_arrays(path, frame, _CANONICAL_LAYOUT, what="canonical frame")


def read_canonical(path: str | Path) -> CanonicalEyeglasses:
    """Return a frame that `write_canonical` wrote; its plan is empty.

    Raises EyeglassesError, naming the file, when it is missing, damaged or something else.

    Parameters
    ----------
    path : str or Path
    """
    arrays = read_arrays(path, _CANONICAL_LAYOUT, what="canonical frame", example="canonical.npz")
    return CanonicalEyeglasses(**arrays, plan=Plan())


def write_registered(path: str | Path, frame: RegisteredEyeglasses) -> None:
    """Write a frame that `register_on_face` placed, all but its plan and trace, atomically.

    Raises ValueError when the name does not end in .npz, OutputError when the folder cannot be written.

    Parameters
    ----------
    path : str or Path
    frame : RegisteredEyeglasses
    """
    write_arrays(path, frame, _REGISTERED_LAYOUT, what="registered frame")


def read_registered(path: str | Path) -> RegisteredEyeglasses:
    """Return a frame that `write_registered` wrote; its plan and trace are empty.

    Raises EyeglassesError, naming the file, when it is missing, damaged or something else.

    Parameters
    ----------
    path : str or Path
    """
    arrays = read_arrays(path, _REGISTERED_LAYOUT, what="registered frame", example="registered.npz")
    return RegisteredEyeglasses(**arrays, plan=Plan(), trace=Trace())


def write_frame_glb(path: Path, frame: CanonicalEyeglasses | RegisteredEyeglasses) -> SkinWritten:
    """Write a frame with its key points as joints; raises OutputError when the folder cannot be written."""
    mesh = frame.vertices, frame.faces, frame.keypoints, frame.weights
    return write_skinned_glb(path, *mesh, KEY_POINT_NAMES, parents=PARENTS)


class StartFile(Record):
    """The content of a file with a pose."""

    format: Literal["scan2albedo eyeglasses start"] = "scan2albedo eyeglasses start"
    format_version: Literal[1] = 1
    unit: LengthUnit = Field(description="Of the translation.")
    world_from_glasses: Matrix = Field(
        description="Row-major 4x4 acting on column vectors: the frame's own coordinates into the cameras' "
        "world; rigid."
    )

    @model_validator(mode="after")
    def _rigid(self) -> StartFile:
        matrix = np.array(self.world_from_glasses)
        rotation = matrix[:3, :3]
        off = np.abs(rotation @ rotation.T - np.eye(3)).max()
        if not (off <= _ROUNDED and np.linalg.det(rotation) > 0 and (matrix[3] == [0, 0, 0, 1]).all()):
            raise ValueError("world_from_glasses must be a rotation and a translation over the row 0 0 0 1")
        return self


def write_start(path: str | Path, world_from_glasses: ArrayLike, unit: LengthUnit = "mm") -> None:
    """Write a pose (4, 4) as JSON, atomically.

    Raises ValueError when it is no rigid transform, OutputError when the file cannot be written.

    Parameters
    ----------
    path : str or Path
    world_from_glasses : (4, 4) array_like of float
        Rigid.
    unit : {"mm", "cm", "m"}
        Of the translation; only noted in the file.
    """
    content = StartFile(unit=unit, world_from_glasses=plain_json(np.asarray(world_from_glasses, np.float64)))
    write_record(path, content)


def read_start(path: str | Path) -> FloatArray:
    """Return the pose (4, 4) of a file, its translation in mm.

    Raises EyeglassesError, naming the file, when it cannot be read or holds no rigid transform.

    Parameters
    ----------
    path : str or Path
    """
    content = read_json(path, StartFile, "start", writer="write_start", schema="eyeglasses_start")
    pose = np.array(content.world_from_glasses)
    pose[:3, 3] *= MM_PER_UNIT[content.unit]
    return pose
