"""Masks of glasses in pictures: one PNG a camera, named after it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scan2albedo.errors import EyeglassesError, ScanError
from scan2albedo.eyeglasses.files.camera_files import Camera
from scan2albedo.io.atomic import make_folder
from scan2albedo.io.images import read_image_linear, write_png

BoolArray = NDArray[np.bool_]


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

    Parameters
    ----------
    folder : str or Path
        With a file ``<camera>.png`` for each camera.
    cameras : sequence of Camera

    Raises
    ------
    EyeglassesError
        When a mask is missing, no picture, or not as large as its camera's; names the file.
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
