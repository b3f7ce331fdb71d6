"""Albedos of processed scans, and the templates of all that a manifest names."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scan2albedo.errors import RecognitionError, Scan2AlbedoError
from scan2albedo.io.geometry_image_files import read_image_and_albedo
from scan2albedo.io.images import SUPPORTED_IMAGES, read_exr_channels, read_image_linear
from scan2albedo.io.records import read_record
from scan2albedo.io.result_records import APPLICATION_FILE, ApplicationRecord, ResultRecord
from scan2albedo.recognition.manifest import Manifest
from scan2albedo.recognition.options import TemplateOptions
from scan2albedo.recognition.templates import Chart, Templates, common_chart, image_coefficients

RESULT_FILE, IMAGE_FILE = "result.json", "geometry_image.npz"
_NO_MODEL = "none"


@dataclass(frozen=True)
class StoredAlbedo:
    """An albedo from files."""

    albedo_linear: NDArray[np.float32]
    """(H, W, 3)."""
    seen: NDArray[np.bool_]
    """(H, W): texels that the scanner saw; others have the colour of the closest point of the scan."""
    chart: Chart
    """On which it lies."""


def read_albedo(path: str | Path) -> StoredAlbedo:
    """Return the albedo of the folder of a processed scan, of what an application wrote, or of an image.

    Parameters
    ----------
    path : path
        A folder with result.json or application.json, geometry_image.npz and albedo.exr; a file in such a
        folder means the folder. Any other image must be on the model's chart: its texels count where alpha is
        half or more or, without alpha, where they are not black.

    Raises
    ------
    RecognitionError
        When something is missing, cannot be read, or holds no albedo on a model's chart; names it.
    """
    source = Path(path)
    if source.is_file() and (source.parent / IMAGE_FILE).is_file():
        source = source.parent
    try:
        return _of_folder(source) if source.is_dir() else _of_image(source)
    except RecognitionError:
        raise
    except Scan2AlbedoError as error:
        text = str(error) if str(source) in str(error) else f"{source}: {error}"
        raise RecognitionError(text) from error


def _of_folder(folder: Path) -> StoredAlbedo:
    model = _model_name(folder)
    if model == _NO_MODEL:
        raise RecognitionError(
            f"{folder}: was processed without a model, so its chart is its own and texels do not correspond "
            "to those of others; process the scan with a model"
        )
    image, albedo = read_image_and_albedo(folder)
    return StoredAlbedo(albedo, image.seen, Chart(model, image.shape))


def _model_name(folder: Path) -> str:
    if (folder / RESULT_FILE).is_file():
        return str(read_record(folder / RESULT_FILE, ResultRecord).options.get("model", _NO_MODEL))
    if (folder / APPLICATION_FILE).is_file():
        return read_record(folder / APPLICATION_FILE, ApplicationRecord).model
    raise RecognitionError(
        f"{folder}: holds no {RESULT_FILE}; give the folder of one processed scan, OUT/<scan name>"
    )


def _of_image(file: Path) -> StoredAlbedo:
    if file.suffix.lower() == ".npz":
        raise RecognitionError(
            f"{file}: is a NumPy archive; a file of templates stands for a whole gallery, in place of the "
            "CSV file"
        )
    if file.suffix.lower() not in SUPPORTED_IMAGES:
        raise RecognitionError(
            f"{file}: is neither the folder of a processed scan nor an image ({', '.join(SUPPORTED_IMAGES)})"
        )
    albedo, alpha = read_image_linear(file), _alpha(file)
    seen = albedo.max(-1) > 0 if alpha is None else alpha >= 0.5
    return StoredAlbedo(albedo, seen, Chart(None, (albedo.shape[0], albedo.shape[1])))


def _alpha(file: Path) -> NDArray[np.float32] | None:
    """Return (H, W) the alpha channel of an image, 0 to 1, or None."""
    if file.suffix.lower() == ".exr":
        return read_exr_channels(file).get("A")
    import cv2

    pixels = cv2.imdecode(np.frombuffer(file.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.ndim != 3 or pixels.shape[2] != 4:
        return None
    alpha = np.asarray(pixels)[..., 3]
    most = {np.dtype(np.uint8): 255.0, np.dtype(np.uint16): 65535.0}.get(alpha.dtype, 1.0)
    return np.asarray(alpha / most, np.float32)


CountCallback = Callable[[int, int], None]
"""Called with how many are done, of how many."""


def result_templates(
    manifest: Manifest,
    *,
    options: TemplateOptions = TemplateOptions(),
    on_count: CountCallback | None = None,
) -> Templates:
    """Return the templates of a manifest's results, from the albedo of the texels that were seen.

    Their names are the persons', or the result's where no person is named. About 0.1 s a result of 512
    texels; one is in memory at a time.

    Parameters
    ----------
    manifest : Manifest
    options : TemplateOptions
    on_count : callable, optional
        Called after each result with how many are done, and of how many.

    Raises
    ------
    RecognitionError
        When a result cannot be read or used, or results differ in size or model; names file, line and result.
    """
    coefficients, masks = [], []
    charts: list[tuple[str, Chart]] = []
    for k, entry in enumerate(manifest.entries):
        where = manifest.where(entry)
        try:
            stored = read_albedo(entry.path)
            bands, carried = image_coefficients(stored.albedo_linear, stored.seen, options, entry.result)
        except RecognitionError as error:
            raise RecognitionError(f"{where}: {error}") from error
        for other, chart in charts:
            common_chart(chart, stored.chart, other, where)
        if not charts or (stored.chart.model is not None and charts[-1][1].model is None):
            charts.append((entry.result, stored.chart))
        coefficients.append(bands.astype(np.complex64))
        masks.append(carried)
        if on_count is not None:
            on_count(k + 1, len(manifest.entries))
    names = tuple(entry.person or entry.result for entry in manifest.entries)
    return Templates(np.stack(coefficients), np.stack(masks), names, options, charts[-1][1])
