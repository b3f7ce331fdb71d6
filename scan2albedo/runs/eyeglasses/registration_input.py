"""What a frame is registered on a face from: files of the frame, the views, and what else is known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scan2albedo.core import RawScan
from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses import (
    Camera,
    read_cameras,
    read_canonical,
    read_labels,
    read_masks,
    read_registered,
    read_start,
)
from scan2albedo.eyeglasses.files.camera_files import mask_path
from scan2albedo.io import load_scan
from scan2albedo.io.input_hash import file_sha256, input_sha256
from scan2albedo.runs.eyeglasses.input import read_frame

CANONICAL = ".npz"
"""Extension of frames that bring their weights, and of results whose pose is a start."""


@dataclass(frozen=True)
class RegistrationFiles:
    """Names of the files of one registration; see `read_registration`."""

    mesh: Path
    """With key points beside it, or the `canonical.npz` of a canonical frame."""
    cameras: Path
    labels: Path
    masks: Path | None = None
    """Folder of masks, named after the cameras."""
    head: Path | None = None
    """A mesh in the cameras' frame."""
    keypoints: Path | None = None
    start: Path | None = None
    """A pose, or the `registered.npz` of an earlier run."""
    unit: str = "auto"
    """Of the mesh."""


@dataclass(frozen=True)
class RestFrame:
    """A frame before it is placed, in mm."""

    vertices: FloatArray
    """(V, 3)."""
    faces: IntArray
    """(F, 3)."""
    keypoints: FloatArray
    """(20, 3), NaN where it lacks them."""
    weights: FloatArray | None
    """(V, 20), when it brings them."""
    mm_per_unit: float
    """Of its file."""


@dataclass(frozen=True)
class RegistrationInput:
    """What was read; lengths in mm."""

    name: str
    """Of the frame."""
    frame: RestFrame
    cameras: tuple[Camera, ...]
    labels: FloatArray
    """(C, 20, 2) pixels, NaN for missing ones."""
    masks: tuple[BoolArray | None, ...]
    head: RawScan | None
    start: FloatArray | None
    """(4, 4) `world_from_glasses`."""
    notes: tuple[str, ...]
    """What reading decided, repaired and did not find."""
    hashes: Mapping[str, tuple[Path, str]]
    """File and SHA-256 of each input."""


def read_registration(files: RegistrationFiles) -> RegistrationInput:
    """Read the files of a registration.

    Raises EyeglassesError or ScanError, naming the file, when one cannot be read or they do not belong
    together; ValueError for an unknown unit, or key points for a frame that already has them.
    """
    cameras = read_cameras(files.cameras)
    hashes = {"cameras": _hashed(files.cameras), "labels": _hashed(files.labels)}
    labels, notes = _read_labels(files.labels, cameras)
    masks = tuple(_mask_of(files.masks, camera, notes, hashes) for camera in cameras)
    if files.masks is not None and all(mask is None for mask in masks):
        names = ", ".join(f"{camera.name}.png" for camera in cameras)
        raise EyeglassesError(f"masks {files.masks}: the folder holds none of {names}")
    start = None
    if files.start is not None:
        start, hashes["start"] = _read_start(files.start), _hashed(files.start)
    frame = _read_frame(files, notes, hashes)
    head = None if files.head is None else _read_head(files.head, notes, hashes)
    return RegistrationInput(
        name=_name(files.mesh),
        frame=frame,
        cameras=cameras,
        labels=labels,
        masks=masks,
        head=head,
        start=start,
        notes=tuple(notes),
        hashes=hashes,
    )


def _read_labels(path: Path, cameras: tuple[Camera, ...]) -> tuple[FloatArray, list[str]]:
    """Return labels (C, 20, 2), and notes on cameras without any and on labels outside a picture."""
    listed = read_labels(path)
    try:
        labels = listed.of_cameras([camera.name for camera in cameras])
    except EyeglassesError as error:
        raise EyeglassesError(f"labels {path}: {error}") from error
    notes = []
    for camera, pixels in zip(cameras, labels, strict=True):
        given = pixels[np.isfinite(pixels).all(1)]
        limit = np.array([camera.shape[1], camera.shape[0]]) - 0.5
        outside = int(((given < -0.5) | (given > limit)).any(1).sum())
        if len(given) == 0:
            notes.append(f"no label in the view of {camera.name!r}")
        elif outside:
            notes.append(
                f"{outside} of {len(given)} labels of {camera.name!r} lie outside its picture of "
                f"{camera.shape[1]} x {camera.shape[0]} pixels"
            )
    return labels, notes


def _mask_of(
    folder: Path | None, camera: Camera, notes: list[str], hashes: dict[str, tuple[Path, str]]
) -> BoolArray | None:
    if folder is None:
        return None
    path = mask_path(folder, camera)
    if not path.is_file():
        notes.append(f"no mask of {camera.name!r} ({path} is not there): that view has labels only")
        return None
    mask = read_masks(folder, [camera])[0]
    hashes[f"mask {camera.name}"] = _hashed(path)
    return mask


def _read_start(path: Path) -> FloatArray:
    if path.suffix.lower() == CANONICAL:
        return read_registered(path).world_from_glasses
    return read_start(path)


def _read_frame(files: RegistrationFiles, notes: list[str], hashes: dict[str, tuple[Path, str]]) -> RestFrame:
    mesh = files.mesh
    if mesh.suffix.lower() == CANONICAL:
        if files.keypoints is not None or files.unit not in ("auto", "mm"):
            raise ValueError(f"{mesh.name} brings its own key points, and is in mm")
        canonical = read_canonical(mesh)
        hashes["mesh"] = _hashed(mesh)
        return RestFrame(
            canonical.vertices, canonical.faces, canonical.keypoints, canonical.weights, mm_per_unit=1.0
        )
    read = read_frame(mesh, files.keypoints, files.unit)
    notes += _notes_of(mesh, read.scan)
    hashes["mesh"] = (mesh, read.mesh_sha256)
    hashes["keypoints"] = (read.keypoints_file, read.keypoints_sha256)
    return RestFrame(read.scan.vertices, read.scan.faces, read.keypoints, None, read.mm_per_unit)


def _read_head(path: Path, notes: list[str], hashes: dict[str, tuple[Path, str]]) -> RawScan:
    head = load_scan(path)
    notes += [f"head {note}" for note in _notes_of(path, head)]
    hashes["head"] = (path, input_sha256(path))
    return head


def _notes_of(path: Path, scan: RawScan) -> list[str]:
    """Return the notes of reading a mesh; that it has no colours does not matter here."""
    return [f"{path.name}: {note}" for note in scan.notes if "geometry only" not in note]


def _name(mesh: Path) -> str:
    """Return the frame's name: all canonical frames' files are called alike, their folders are not."""
    folder = mesh.absolute().parent.name
    return folder if mesh.name == "canonical.npz" and folder else mesh.stem


def _hashed(path: Path) -> tuple[Path, str]:
    try:
        return path, file_sha256(path)
    except OSError as error:
        raise EyeglassesError(f"{path}: {error.strerror}; check the path") from error
