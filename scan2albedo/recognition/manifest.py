"""Results and the persons they show, from a CSV file or a folder; their albedos and surfaces."""

import unicodedata
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scan2albedo.core.arrays import FloatArray, RealArray, Texts
from scan2albedo.errors import RecognitionError, Scan2AlbedoError, needs_extra, one_line
from scan2albedo.io.csv_tables import cells_by_column, read_text, table_rows
from scan2albedo.io.geometry_image_files import read_geometry_image, read_image_and_albedo
from scan2albedo.io.images import SUPPORTED_IMAGES, read_exr_channels, read_image_linear
from scan2albedo.io.records import read_record
from scan2albedo.io.result_records import APPLICATION_FILE, ApplicationRecord, ResultRecord
from scan2albedo.recognition.templates import Chart, Kind, NothingToCompareError, certainty

RESULT_FILE, CATALOGUE_FILE = "result.json", "catalogue.parquet"
IMAGE_FILE, ALBEDO_FILE, ERROR_FILE = "geometry_image.npz", "albedo.exr", "expected_error.exr"


@dataclass(frozen=True)
class ManifestEntry:
    """One line of a manifest."""

    person: str | None
    """Who is shown; None where the cell is empty."""
    result: str
    """As written in the file."""
    path: Path
    """The result itself; relative ones lie in the folder of the file."""
    line: int | None = None
    """Number of the line in the file; None in a folder."""


@dataclass(frozen=True)
class Manifest:
    """The entries of a CSV file or a folder, one or more."""

    file: Path
    entries: tuple[ManifestEntry, ...]
    """`file`, `entries`: the file or folder, and its results in order."""
    notes: Texts = ()
    """What is odd about them, one sentence each."""

    def where(self, entry: ManifestEntry) -> str:
        """Return file, line and result of an entry, for messages."""
        if entry.line is None:
            return str(entry.path)
        return f"{self.file}, line {entry.line}: {entry.result}"


def read_manifest(path: str | Path, *, persons_required: bool = True) -> Manifest:
    """Return the entries of a CSV file with the columns `person` and `result`, or of a folder, at `path`.

    UTF-8 with or without a byte order mark; the header shows whether commas, semicolons or tabs separate
    cells. Other columns and empty lines are ignored. Of a folder, every result `FOLDER/PERSON/SCAN` shows
    PERSON, and `FOLDER/SCAN` the person that the column `person` of the batch's catalogue names or, without
    that column, a person called SCAN. Every line has to name a person where `persons_required`.

    RecognitionError, which names file and line, when the file is missing, no text, lacks a column or has no
    entry; when an entry lacks person or result, a result does not exist or is named with two persons.
    MissingDependencyError when a folder holds a catalogue, and pyarrow, which reads it, is not installed.
    """
    file = Path(path)
    if file.is_dir():
        return _of_folder(file, persons_required)
    advice = "give a CSV file with the columns person and result"
    text = read_text(file, what=str(file), advice=advice, error=RecognitionError)
    rows = [(line, [cell.strip() for cell in row]) for line, row in table_rows(text, file, RecognitionError)]
    header = [cell.lower() for cell in rows[0][1]] if rows else []
    if missing := [name for name in ("person", "result") if name not in header]:
        found = f"its first line has {', '.join(rows[0][1])}" if rows else "it is empty"
        raise RecognitionError(
            f"{file} lacks the column{'s' * (len(missing) > 1)} {' and '.join(missing)} ({found}); begin it "
            f"with a header of person,result"
        )
    entries: list[ManifestEntry] = []
    for line, row in rows[1:]:
        where = f"{file}, line {line}"
        cells = cells_by_column(header, row, where, RecognitionError)
        person, result = unicodedata.normalize("NFC", cells["person"]), cells["result"]
        if not result:
            raise RecognitionError(f"{where}: names no result; give the folder of a processed scan")
        if persons_required and not person:
            raise RecognitionError(f"{where}: {result} has no person; name who is shown")
        entry = ManifestEntry(person or None, result, file.parent / result, line)
        if not entry.path.exists():
            raise RecognitionError(
                f"{where}: {result}: no such folder or file; relative paths start from {file.parent}"
            )
        entries.append(entry)
    if not entries:
        raise RecognitionError(f"{file} has no entry below its header; add lines of person and result")
    # A result that is named twice is noted; two persons for one result are an error.
    first: dict[Path, ManifestEntry] = {}
    notes = []
    for entry in entries:
        other = first.setdefault(entry.path.resolve(), entry)
        if other is entry:
            continue
        if other.person != entry.person:
            raise RecognitionError(
                f"{file}: {entry.result} shows {other.person or 'nobody known'} on line {other.line} and "
                f"{entry.person or 'nobody known'} on line {entry.line}; leave one of them out"
            )
        notes.append(f"{file}: {entry.result} comes twice, on lines {other.line} and {entry.line}")
    return Manifest(file, tuple(entries), tuple(notes))


def _of_folder(folder: Path, persons_required: bool) -> Manifest:
    def holds_result(of: Path) -> bool:
        """Whether it is the folder of one processed scan, or of a face that an application wrote."""
        return any((of / name).is_file() for name in (RESULT_FILE, APPLICATION_FILE, IMAGE_FILE))

    def folders(of: Path) -> list[Path]:
        return sorted(path for path in of.iterdir() if path.is_dir() and not path.name.startswith("."))

    if holds_result(folder):
        raise RecognitionError(
            f"{folder}: is one result; give the folder that holds the folders of results, or a CSV file with "
            "the columns person and result"
        )
    # The persons of a batch's catalogue by the scan's name, where it has that column.
    person_of, catalogue = None, folder / CATALOGUE_FILE
    if catalogue.is_file():
        with needs_extra("batch"):
            import pyarrow
            import pyarrow.parquet as parquet
        try:
            if {"name", "person"} <= set(parquet.read_schema(catalogue).names):
                rows = parquet.read_table(catalogue, columns=["name", "person"]).to_pylist()
                person_of = {
                    row["name"]: unicodedata.normalize("NFC", (row["person"] or "").strip()) for row in rows
                }
        except (OSError, pyarrow.ArrowException) as error:
            raise RecognitionError(
                f"{catalogue}: cannot be read ({one_line(error)}); move it away, or repair the batch"
            ) from error
    entries = []
    for first in folders(folder):
        if holds_result(first):
            person = first.name if person_of is None else person_of.get(first.name)
            # A scan whose cell is empty stays alone: in a gallery it is called by its folder.
            entries.append(
                ManifestEntry(person or (first.name if persons_required else None), first.name, first)
            )
            continue
        for second in filter(holds_result, folders(first)):
            entries.append(ManifestEntry(first.name, f"{first.name}/{second.name}", second))
    if not entries:
        raise RecognitionError(
            f"{folder}: holds no folder of a processed scan, neither SCAN nor PERSON/SCAN; process scans "
            "with -o, or give a CSV file"
        )
    return Manifest(folder, tuple(entries))


@dataclass(frozen=True)
class StoredFace:
    """An albedo, or the surface of a processed scan, from files."""

    values: RealArray
    """(H, W, 3): linear albedo or texture, texture over albedo, or unit outward normals in the model's
    frame."""
    certainty: FloatArray
    """(H, W): how certain they are (see `templates.certainty`), 0 where the scanner saw nothing."""
    chart: Chart
    """On which it lies."""


def read_face(path: str | Path, kind: Kind = "albedo") -> StoredFace:
    """Return the albedo or the shape, by `kind`, of a processed scan, of an application, or of an image.

    `path` is a folder with geometry_image.npz, its record result.json or application.json if it has one, and,
    but for the shape, albedo.exr and, where errors are known, expected_error.exr; a file in such a folder
    means the folder. Any other image is an albedo and must be on the model's chart: its texels count where
    alpha is half or more or, without alpha, where they are not black.

    RecognitionError, which names the file, when something is missing, cannot be read, or is not on a model's
    chart: a `NothingToCompareError` for anything but the albedo of an image or the shape of a scan without
    colour.
    """
    source = Path(path)
    if source.is_file() and (source.parent / IMAGE_FILE).is_file():
        source = source.parent
    try:
        return _face_of_folder(source, kind) if source.is_dir() else _face_of_image(source, kind)
    except RecognitionError:
        raise
    except Scan2AlbedoError as error:
        text = str(error) if str(source) in str(error) else f"{source}: {error}"
        raise RecognitionError(text) from error


def _face_of_folder(folder: Path, kind: Kind) -> StoredFace:
    model, common = None, False  # unknown in a folder of images without a record
    if (folder / RESULT_FILE).is_file():
        record = read_record(folder / RESULT_FILE, ResultRecord)
        model, common = str(record.options.get("model", "none")), "person" in record.metrics
    elif (folder / APPLICATION_FILE).is_file():
        model = read_record(folder / APPLICATION_FILE, ApplicationRecord).model
    elif not (folder / IMAGE_FILE).is_file():
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
        return StoredFace(image.normal, image.seen.astype(float), Chart(model, image.shape))
    lacks_albedo = (folder / IMAGE_FILE).is_file() and not (folder / ALBEDO_FILE).is_file()
    if lacks_albedo and read_geometry_image(folder / IMAGE_FILE).texture_linear is None:
        raise NothingToCompareError(f"{folder}: has no {kind}, for the scan has no colour; compare by shape")
    image, albedo = read_image_and_albedo(folder)
    values: RealArray | None = albedo if kind == "albedo" else image.texture_linear
    # The common albedo of a person's scans is in no light: its texture is the albedo once more.
    if values is None or (common and kind != "albedo"):
        raise NothingToCompareError(f"{folder}: has no texture of its own; compare by albedo and shape")
    if kind == "shading":
        values = np.divide(values, albedo, out=np.zeros(albedo.shape), where=albedo > 0)
    known = image.seen.astype(float)
    if (errors := folder / ERROR_FILE).is_file():
        known = certainty(albedo, read_image_linear(errors)[..., 0], image.seen)
    return StoredFace(values, known, Chart(model, image.shape))


def _face_of_image(file: Path, kind: Kind) -> StoredFace:
    if kind != "albedo":
        raise NothingToCompareError(f"{file}: is an image, which has no {kind}; give the folder of the scan")
    if file.suffix.lower() not in SUPPORTED_IMAGES:
        raise RecognitionError(
            f"{file}: is neither the folder of a processed scan nor an image "
            f"({', '.join(SUPPORTED_IMAGES)}); "
            "a file of templates (.npz) stands for a whole gallery, in place of the CSV file"
        )
    albedo = read_image_linear(file)
    alpha: RealArray | None
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
    return StoredFace(albedo, seen.astype(float), Chart(None, (albedo.shape[0], albedo.shape[1])))
