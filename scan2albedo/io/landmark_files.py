"""Landmarks as files: those of a fitted face, and those placed on a scan (CSV, JSON, MeshLab)."""

import math
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from pydantic import Field

from scan2albedo.core.arrays import FloatArray
from scan2albedo.core.landmarks import COUNT, PLACED_SIGMA_MM, PlacedLandmarks
from scan2albedo.errors import ScanError, errors_of
from scan2albedo.io.csv_tables import cells_by_column, read_text, table_rows
from scan2albedo.io.limits import NAME_BYTES, parse_json
from scan2albedo.io.records import NonNegative, Number, Positive, Record

PARTS = {
    "jaw": range(17),
    "right brow": range(17, 22),
    "left brow": range(22, 27),
    "nose": range(27, 36),
    "right eye": range(36, 42),
    "left eye": range(42, 48),
    "lips": range(48, 68),
}
"""iBUG-68 numbers, from 0; right and left are the subject's."""

_ADVICE = (
    f"give rows of number (0 to {COUNT - 1}), x, y, z; a landmarks.json or landmarks.csv of `process`; or a "
    ".pp of MeshLab whose points have numbers as names"
)

Point = tuple[Number, Number, Number]


LANDMARKS_FILE = "landmarks.json"


class LandmarkRecord(Record):
    """One landmark."""

    number: int = Field(ge=0, le=67, description="iBUG-68, from 0.")
    part: str = Field(description="Of the face; right and left are the subject's.")
    model_mm: Point = Field(description="In the frame of fitted.glb.")
    scan: Point = Field(description="In the frame and unit of the scan's file.")
    deviation_mm: NonNegative = Field(description="Standard deviation along each axis.")


class LandmarksRecord(Record):
    """The content of `landmarks.json`."""

    format_version: Literal[1] = 1
    mm_per_unit: Positive = Field(description="Of the scan's file.")
    landmarks: tuple[LandmarkRecord, ...] = Field(min_length=68, max_length=68)

    @classmethod
    def of(cls, model_mm: FloatArray, scan: FloatArray, deviation_mm: FloatArray, mm_per_unit: float) -> Self:
        """Return the record of landmarks (68, 3) in both frames with their deviations (68,)."""
        parts = [part for part, numbers in PARTS.items() for _ in numbers]
        columns = (range(COUNT), parts, model_mm.tolist(), scan.tolist(), deviation_mm.tolist())
        names = LandmarkRecord.model_fields
        rows = zip(*columns, strict=True)
        marks = tuple(LandmarkRecord(**dict(zip(names, row, strict=True))) for row in rows)
        return cls(mm_per_unit=mm_per_unit, landmarks=marks)


def write_landmarks_csv(file: Path, record: LandmarksRecord) -> None:
    """Write the landmarks as a table, a row each."""
    rows = ["number,part,model_x_mm,model_y_mm,model_z_mm,scan_x,scan_y,scan_z,deviation_mm"]
    for point in record.landmarks:
        places = [f"{value:.4f}" for value in point.model_mm] + [f"{value:.9g}" for value in point.scan]
        rows.append(",".join((str(point.number), point.part, *places, f"{point.deviation_mm:.2f}")))
    file.write_text("\n".join((*rows, "")), encoding="utf-8", newline="")


def read_landmarks(file: str | Path, mm_per_unit: float = 1.0) -> PlacedLandmarks:
    """Return the landmarks of a file, in mm; any subset of the 68, numbered from 0 in iBUG-68 order.

    - ``.csv``, ``.txt``: columns number, x, y, z (also scan_x, scan_y, scan_z, as `process` writes them) and
      where wanted sigma_mm; without a header the first four cells.
    - ``.json``: ``{"36": [x, y, z], ...}``, a list of 68 points with null for those not placed, or a
      `landmarks.json` of `process`.
    - ``.pp``: points picked with MeshLab, their names the numbers; inactive ones are left out.

    The points are in the frame and unit, of `mm_per_unit`, of the scan's file. Raises ScanError.
    """
    path = Path(file)
    readers = {".csv": _of_table, ".txt": _of_table, ".json": _of_json, ".pp": _of_picked_points}
    if (reader := readers.get(path.suffix.lower())) is None:
        raise ScanError(f"{path}: landmarks are read from .csv, .json and .pp files; {_ADVICE}")
    most = COUNT * NAME_BYTES  # a long line each
    text = read_text(path, what=f"landmarks {path}", advice=_ADVICE, error=ScanError, limit=most)
    points, sigma_mm = np.full((COUNT, 3), np.nan), np.full(COUNT, PLACED_SIGMA_MM)
    seen: dict[float, str] = {}
    for where, written, place, sigma in reader(text, path):
        number = _number(written)
        if number not in range(COUNT):
            known = f"the number of a landmark (0 to {COUNT - 1})"
            raise ScanError(f"{where}: {str(written)[:40]!r} is not {known}; {_ADVICE}")
        if number in seen:
            raise ScanError(f"{where}: landmark {int(number)} was given before ({seen[number]}); keep one")
        if not isinstance(place, list | tuple) or len(place) != 3:
            raise ScanError(f"{where}: {str(place)[:40]} are not three coordinates; {_ADVICE}")
        seen[number] = where
        for value in (*place, sigma):
            if not math.isfinite(_number(value)):
                raise ScanError(f"{where}: {str(value)[:40]!r} is not a finite number; {_ADVICE}")
        points[int(number)] = [_number(value) * mm_per_unit for value in place]
        sigma_mm[int(number)] = _number(sigma)
    with errors_of(str(path), ScanError):
        return PlacedLandmarks(points, sigma_mm)


def _number(written: Any) -> float:
    """Return a number as written in a file, NaN for what is none."""
    with suppress(TypeError, ValueError, OverflowError):
        return math.nan if isinstance(written, bool) else float(written)
    return math.nan


# The readers yield, of each point: where it stands, its number, coordinates and deviation as written.
_Points = Iterator[tuple[str, Any, Any, Any]]


def _of_table(text: str, file: Path) -> _Points:
    rows = table_rows(text, file, ScanError)
    header = [cell.strip().lower() for cell in rows[0][1]] if rows else []
    if "number" not in header:
        for line, row in rows:
            yield f"{file}, line {line}", row[0].strip(), row[1:4], PLACED_SIGMA_MM
        return
    kinds = (("scan_x", "scan_y", "scan_z"), ("x", "y", "z"))
    columns = next((names for names in kinds if set(names) <= set(header)), None)
    if columns is None:
        raise ScanError(f"{file}: has no columns x, y and z; {_ADVICE}")
    deviation = next((name for name in ("sigma_mm", "deviation_mm") if name in header), "")
    for line, row in rows[1:]:
        where = f"{file}, line {line}"
        cells = cells_by_column(header, row, where, ScanError)
        place = [cells[name] for name in columns]
        if any(place):  # a row without coordinates is a landmark that was not placed
            yield where, cells["number"].strip(), place, cells.get(deviation) or PLACED_SIGMA_MM


def _of_json(text: str, file: Path) -> _Points:
    with errors_of(f"{file}: is no JSON", ScanError, ValueError, RecursionError, advice=_ADVICE):
        tree = parse_json(file.name, text.encode())
    listed = tree.get("landmarks", tree) if isinstance(tree, dict) else tree
    if isinstance(listed, dict):
        listed = [{"number": number, "scan": place} for number, place in listed.items()]
    if not isinstance(listed, list):
        raise ScanError(f"{file}: holds no landmarks; {_ADVICE}")
    for index, entry in enumerate(listed):
        row = entry if isinstance(entry, dict) else {"number": index, "scan": entry}
        place = row.get("scan", row.get("point"))
        if place is not None:
            sigma_mm = row.get("deviation_mm", row.get("sigma_mm", PLACED_SIGMA_MM))
            yield f"{file}, landmark {index}", row.get("number"), place, sigma_mm


def _of_picked_points(text: str, file: Path) -> _Points:
    from xml.etree import ElementTree

    faults, said = (ElementTree.ParseError, RecursionError), f"{file}: is not a file of picked points"
    with errors_of(said, ScanError, *faults, advice=_ADVICE):
        tree = ElementTree.fromstring(text)
    for index, point in enumerate(tree.iter("point")):
        if point.get("active", "1") != "0":
            place = [point.get(axis) for axis in "xyz"]
            yield f"{file}, point {index}", point.get("name"), place, PLACED_SIGMA_MM


def landmarks_file(location: str | Path, scan: str | Path | None) -> Path | None:
    """Return the file of a scan's landmarks: the file given, or that of its stem in the folder given."""
    path = Path(location)
    if not path.is_dir():
        return path
    stem = "" if scan is None else Path(scan).stem
    found = (path / f"{stem}{extension}" for extension in (".csv", ".json", ".pp", ".txt"))
    return next((file for file in found if stem and file.is_file()), None)
