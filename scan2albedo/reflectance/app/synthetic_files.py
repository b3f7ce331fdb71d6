"""Synthetic captures and photographs as the files that a person with cameras would bring."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scan2albedo.io.images import write_png
from scan2albedo.io.result_folder import result_folder
from scan2albedo.reflectance import write_capture, write_photograph
from scan2albedo.reflectance.capture_files import FlashCaptureFile, PairEntry, PoseEntry
from scan2albedo.reflectance.photograph_files import FacePhotographFile
from scan2albedo.synthetic import FacePhotograph, FlashCapture

CAPTURE_FILE, PHOTOGRAPH_FILE = "capture.json", "photograph.json"
_MESH, _IMAGE, _SKIN = "face.ply", "image.png", "skin.png"
_SATURATION = 0.98


def write_synthetic_capture(capture: FlashCapture, folder: Path) -> Path:
    """Write pictures, masks, mesh and capture file of a synthetic capture; return the file's path.

    Raises
    ------
    ValueError
        When the capture has no integers for pictures.
    OutputError
        Naming the folder and the cause.
    """
    _refuse_floats(capture.options.bits)
    with result_folder(folder, CAPTURE_FILE) as staging:
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
    return folder / CAPTURE_FILE


def write_synthetic_photograph(taken: FacePhotograph, folder: Path, *, mesh: bool = True) -> Path:
    """Write image, mask, landmarks and, unless it shall be found, the mesh; return the file's path.

    Raises
    ------
    ValueError
        When the photograph has no integers for the image.
    OutputError
        Naming the folder and the cause.
    """
    _refuse_floats(taken.options.bits)
    landmarks = [None if np.isnan(pixel).any() else pixel.tolist() for pixel in taken.landmarks_px]
    with result_folder(folder, PHOTOGRAPH_FILE) as staging:
        write_png(staging / _IMAGE, taken.image)
        write_png(staging / _SKIN, _white_where(taken.skin))
        if mesh:
            _write_mesh(staging / _MESH, taken.vertices, taken.faces)
        content = FacePhotographFile.model_validate(
            {
                "image": _IMAGE,
                "mask": _SKIN,
                "gamma": taken.options.gamma,
                "saturation": _SATURATION,
                "camera": taken.camera.tolist(),
                "mesh": _MESH if mesh else None,
                "landmarks": landmarks,
            }
        )
        write_photograph(staging / PHOTOGRAPH_FILE, content)
    return folder / PHOTOGRAPH_FILE


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
        saturation=_SATURATION,
        falloff_distance=options.distance_mm if options.falloff else None,
        flash_strength=capture.exposure,
        intrinsics=capture.intrinsics.tolist(),
        poses=tuple(PoseEntry.model_validate(pose) for pose in poses),
        pictures=pairs,
    )


def _refuse_floats(bits: int | None) -> None:
    if bits is None:
        raise ValueError("pictures without bits cannot be written as PNG; take 8 or 16 bits")


def _name(number: int) -> str:
    return f"place_{number:02d}"


def _mask(number: int) -> str:
    return f"skin_{number:02d}.png"


def _white_where(mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    return np.repeat(np.where(mask, 255, 0).astype(np.uint8)[..., None], 3, axis=2)


def _write_mesh(path: Path, vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> None:
    import trimesh

    trimesh.Trimesh(vertices, faces, process=False).export(path)
