"""Albedos and surfaces of processed scans, and the templates of all that a manifest names."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scan2albedo.errors import RecognitionError, Scan2AlbedoError
from scan2albedo.io.geometry_image_files import read_geometry_image, read_image_and_albedo
from scan2albedo.io.images import SUPPORTED_IMAGES, read_exr_channels, read_image_linear
from scan2albedo.io.records import read_record
from scan2albedo.io.result_records import APPLICATION_FILE, ApplicationRecord, ResultRecord
from scan2albedo.recognition.manifest import RESULT_FILE, Manifest, ManifestEntry
from scan2albedo.recognition.options import TemplateOptions
from scan2albedo.recognition.preparation import NothingToCompareError
from scan2albedo.recognition.templates import COEFFICIENTS, Chart, Kind, Templates, common_chart

IMAGE_FILE, ALBEDO_FILE = "geometry_image.npz", "albedo.exr"
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


@dataclass(frozen=True)
class StoredShape:
    """The surface of a processed scan, from its geometry image."""

    normal: NDArray[np.float64]
    """(H, W, 3): unit outward normals in the model's frame."""
    seen: NDArray[np.bool_]
    """(H, W): texels that the scanner saw; the model filled in others."""
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
    source = _result_or_file(path)
    with _named(source):
        return _of_folder(source) if source.is_dir() else _of_image(source)


def read_shape(path: str | Path) -> StoredShape:
    """Return the surface of the folder of a processed scan, coloured or not, or of what an application wrote.

    Parameters
    ----------
    path : path
        As of `read_albedo`; images have no shape.

    Raises
    ------
    RecognitionError
        When something is missing, cannot be read, or has no surface on a model's chart; names it.
    NothingToCompareError
        A RecognitionError: when it is an image.
    """
    source = _result_or_file(path)
    if not source.is_dir():
        raise NothingToCompareError(f"{source}: is an image, which has no shape; give the folder of the scan")
    with _named(source):
        model = _model_of(source)
        image = read_geometry_image(source / IMAGE_FILE)
        return StoredShape(image.normal, image.seen, Chart(model, image.shape))


def _result_or_file(path: str | Path) -> Path:
    source = Path(path)
    return source.parent if source.is_file() and (source.parent / IMAGE_FILE).is_file() else source


@contextmanager
def _named(source: Path) -> Iterator[None]:
    """Raise RecognitionError, naming the source, for any fault of its files."""
    try:
        yield
    except RecognitionError:
        raise
    except Scan2AlbedoError as error:
        text = str(error) if str(source) in str(error) else f"{source}: {error}"
        raise RecognitionError(text) from error


def _of_folder(folder: Path) -> StoredAlbedo:
    model = _model_of(folder)
    lacks_albedo = (folder / IMAGE_FILE).is_file() and not (folder / ALBEDO_FILE).is_file()
    if lacks_albedo and read_geometry_image(folder / IMAGE_FILE).texture_linear is None:
        raise NothingToCompareError(f"{folder}: has no albedo, for the scan has no colour; compare by shape")
    image, albedo = read_image_and_albedo(folder)
    return StoredAlbedo(albedo, image.seen, Chart(model, image.shape))


def _model_of(folder: Path) -> str:
    """Return the name of the model on whose chart a result lies; RecognitionError without a model."""
    model = _model_name(folder)
    if model == _NO_MODEL:
        raise RecognitionError(
            f"{folder}: was processed without a model, so its chart is its own and texels do not correspond "
            "to those of others; process the scan with a model"
        )
    return model


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
LeftOutCallback = Callable[[int, str], None]
"""Called with the number of an entry, from 0, that has nothing to compare, and why."""


def result_templates(
    manifest: Manifest,
    *,
    kind: Kind = "albedo",
    options: TemplateOptions = TemplateOptions(),
    on_count: CountCallback | None = None,
    on_left_out: LeftOutCallback | None = None,
) -> Templates:
    """Return the templates of a manifest's results, over the texels that were seen.

    Their names are the persons', or the result's where no person is named. About 0.1 s a result of 512
    texels; one is in memory at a time.

    Parameters
    ----------
    manifest : Manifest
    kind : {"albedo", "shape"}
    options : TemplateOptions
    on_count : callable, optional
        Called after each result with how many are done, and of how many.
    on_left_out : callable, optional
        Called for each result that has nothing to compare, as a scan without colour has no albedo, or that is
        masked everywhere; the others go on. When omitted such a result is an error.

    Raises
    ------
    RecognitionError
        When a result cannot be read or used, or results differ in size or model; names file, line and result.
        When none is left.
    """
    coefficients, masks, names = [], [], []
    charts: list[tuple[str, Chart]] = []
    reasons: list[str] = []
    for k, entry in enumerate(manifest.entries):
        where = manifest.where(entry)
        try:
            image, seen, chart = _stored(kind, entry.path)
            bands, carried = COEFFICIENTS[kind](image, seen, options, entry.result)
            for other, earlier in charts:
                common_chart(earlier, chart, other, where)
        except NothingToCompareError as error:
            if on_left_out is None:
                raise RecognitionError(_told(where, entry, error)) from error
            reasons.append(_told(where, entry, error))
            on_left_out(k, reasons[-1])
            continue
        except RecognitionError as error:
            raise RecognitionError(_told(where, entry, error)) from error
        finally:
            if on_count is not None:
                on_count(k + 1, len(manifest.entries))
        if not charts or (chart.model is not None and charts[-1][1].model is None):
            charts.append((entry.result, chart))
        coefficients.append(bands.astype(np.complex64))
        masks.append(carried)
        names.append(entry.person or entry.result)
    if not names:
        raise RecognitionError(
            f"{manifest.file}: no result has {_A[kind]} to compare; the first: {reasons[0]}"
        )
    return Templates(np.stack(coefficients), np.stack(masks), tuple(names), options, charts[-1][1], kind)


def _told(where: str, entry: ManifestEntry, error: RecognitionError) -> str:
    """Return what is wrong with an entry, after the place where it is named; nothing is named twice."""
    text = str(error)
    if where in text:
        return text
    named = [f"{name}{end}" for name in (entry.path, entry.result) for end in (": ", " ")]
    return f"{where}: {text.removeprefix(next(filter(text.startswith, named), ''))}"


_A: dict[Kind, str] = {"albedo": "an albedo", "shape": "a shape"}


def _stored(kind: Kind, path: Path) -> tuple[NDArray[np.floating], NDArray[np.bool_], Chart]:
    if kind == "shape":
        shape = read_shape(path)
        return shape.normal, shape.seen, shape.chart
    albedo = read_albedo(path)
    return albedo.albedo_linear, albedo.seen, albedo.chart
