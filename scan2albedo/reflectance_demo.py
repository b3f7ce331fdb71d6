"""Synthetic captures as the files that a person with cameras and flashes would bring."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scan2albedo.io.atomic import make_folder
from scan2albedo.io.images import write_png
from scan2albedo.reflectance.capture_files import FlashCaptureFile, PairEntry, PoseEntry, write_capture
from scan2albedo.staging import publish, staging_folder, telling_where
from scan2albedo.synthetic import FlashCapture

CAPTURE_FILE = "capture.json"
_MESH = "face.ply"


def write_synthetic_capture(capture: FlashCapture, folder: Path) -> Path:
    """Write pictures, mesh and capture file of a synthetic capture; return the file's path.

    Raises
    ------
    ValueError
        When the capture has no integers for pictures.
    OutputError
        Naming the folder and the cause.
    """
    if capture.options.bits is None:
        raise ValueError("a capture without bits cannot be written as PNG pictures; take 8 or 16")
    with telling_where(folder), staging_folder(make_folder(folder), "capture") as staging:
        _write_mesh(staging / _MESH, capture.vertices, capture.faces)
        pairs = []
        for j, (view, light) in enumerate(zip(capture.view, capture.light, strict=True)):
            flash, room = f"flash_{view:02d}_{light:02d}.png", f"room_{view:02d}.png"
            write_png(staging / flash, capture.flash[j])
            if light == 0:
                write_png(staging / room, capture.room[j])
                write_png(staging / _mask(view), _white_where(capture.skin[j]))
            pairs.append(
                PairEntry(camera=_name(view), flash=_name(light), flash_image=flash, room_image=room)
            )
        write_capture(staging / CAPTURE_FILE, _content(capture, tuple(pairs)))
        publish(staging, make_folder(folder), CAPTURE_FILE)
    return folder / CAPTURE_FILE


def _content(capture: FlashCapture, pairs: tuple[PairEntry, ...]) -> FlashCaptureFile:
    options = capture.options
    poses = [
        {
            "name": _name(k),
            "rotation": rotation.tolist(),
            "translation": translation.tolist(),
            "mask": _mask(k) if k < options.views else None,
        }
        for k, (rotation, translation) in enumerate(
            zip(capture.head_rotations, capture.head_translations, strict=True)
        )
    ]
    return FlashCaptureFile(
        mesh=_MESH,
        gamma=options.gamma,
        noise=max(options.noise, 0.5 / 255),
        saturation=0.98,
        falloff_distance=options.distance_mm if options.falloff else None,
        flash_strength=capture.exposure,
        intrinsics=capture.intrinsics.tolist(),
        poses=tuple(PoseEntry.model_validate(pose) for pose in poses),
        pictures=pairs,
    )


def _name(number: int) -> str:
    return f"place_{number:02d}"


def _mask(number: int) -> str:
    return f"skin_{number:02d}.png"


def _white_where(mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    return np.repeat(np.where(mask, 255, 0).astype(np.uint8)[..., None], 3, axis=2)


def _write_mesh(path: Path, vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> None:
    import trimesh

    trimesh.Trimesh(vertices, faces, process=False).export(path)
