"""Albedos and surfaces of processed scans."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core.arrays import BoolArray
from scan2albedo.errors import RecognitionError, Scan2AlbedoError
from scan2albedo.io.geometry_image_files import read_geometry_image, read_image_and_albedo
from scan2albedo.io.images import SUPPORTED_IMAGES, read_exr_channels, read_image_linear
from scan2albedo.io.records import read_record
from scan2albedo.io.result_records import APPLICATION_FILE, ApplicationRecord, ResultRecord
from scan2albedo.recognition.manifest import RESULT_FILE
from scan2albedo.recognition.templates import Chart, Kind, NothingToCompareError

IMAGE_FILE, ALBEDO_FILE = "geometry_image.npz", "albedo.exr"


@dataclass(frozen=True)
class StoredFace:
    """An albedo, or the surface of a processed scan, from files."""

    values: NDArray[np.floating]
    """(H, W, 3): linear albedo, or unit outward normals in the model's frame."""
    seen: BoolArray
    """(H, W): texels that the scanner saw; others were filled in."""
    chart: Chart
    """On which it lies."""


def read_face(path: str | Path, kind: Kind = "albedo") -> StoredFace:
    """Return the albedo or the shape, by `kind`, of a processed scan, of an application, or of an image.

    `path` is a folder with result.json or application.json, geometry_image.npz and, for an albedo,
    albedo.exr; a file in such a folder means the folder. Any other image is an albedo and must be on the
    model's chart: its texels count where alpha is half or more or, without alpha, where they are not black.

    RecognitionError, which names the file, when something is missing, cannot be read, or is not on a model's
    chart: a `NothingToCompareError` for the shape of an image and the albedo of a scan without colour.
    """
    source = Path(path)
    if source.is_file() and (source.parent / IMAGE_FILE).is_file():
        source = source.parent
    try:
        return _of_folder(source, kind) if source.is_dir() else _of_image(source, kind)
    except RecognitionError:
        raise
    except Scan2AlbedoError as error:
        text = str(error) if str(source) in str(error) else f"{source}: {error}"
        raise RecognitionError(text) from error


def _of_folder(folder: Path, kind: Kind) -> StoredFace:
    if (folder / RESULT_FILE).is_file():
        model = str(read_record(folder / RESULT_FILE, ResultRecord).options.get("model", "none"))
    elif (folder / APPLICATION_FILE).is_file():
        model = read_record(folder / APPLICATION_FILE, ApplicationRecord).model
    else:
        raise RecognitionError(
            f"{folder}: holds no {RESULT_FILE}; give the folder of one processed scan, OUT/<scan name>"
        )
    if model == "none":
        raise RecognitionError(
            f"{folder}: was processed without a model, so its chart is its own and texels do not correspond "
            "to those of others; process the scan with a model"
        )
    if kind == "shape":
        image = read_geometry_image(folder / IMAGE_FILE)
        return StoredFace(image.normal, image.seen, Chart(model, image.shape))
    lacks_albedo = (folder / IMAGE_FILE).is_file() and not (folder / ALBEDO_FILE).is_file()
    if lacks_albedo and read_geometry_image(folder / IMAGE_FILE).texture_linear is None:
        raise NothingToCompareError(f"{folder}: has no albedo, for the scan has no colour; compare by shape")
    image, albedo = read_image_and_albedo(folder)
    return StoredFace(albedo, image.seen, Chart(model, image.shape))


def _of_image(file: Path, kind: Kind) -> StoredFace:
    if kind == "shape":
        raise NothingToCompareError(f"{file}: is an image, which has no shape; give the folder of the scan")
    if file.suffix.lower() not in SUPPORTED_IMAGES:
        raise RecognitionError(
            f"{file}: is neither the folder of a processed scan nor an image "
            f"({', '.join(SUPPORTED_IMAGES)}); "
            "a file of templates (.npz) stands for a whole gallery, in place of the CSV file"
        )
    albedo = read_image_linear(file)
    alpha: NDArray[np.floating] | None
    if file.suffix.lower() == ".exr":
        alpha = read_exr_channels(file).get("A")
    else:
        from PIL import Image, UnidentifiedImageError

        try:
            with Image.open(file) as opened:
                transparent = opened.has_transparency_data
                alpha = np.asarray(opened.convert("RGBA"))[..., 3] / 255 if transparent else None
        except (OSError, UnidentifiedImageError):  # a format without alpha that Pillow does not read
            alpha = None
    seen = albedo.max(-1) > 0 if alpha is None else alpha >= 0.5
    return StoredFace(albedo, seen, Chart(None, (albedo.shape[0], albedo.shape[1])))
