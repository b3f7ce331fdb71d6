"""Landmarks that someone placed on a scan: CSV, JSON, and points picked with MeshLab."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from scan2albedo.core.landmarks import AUTO, COUNT, PLACED_SIGMA_MM, PlacedLandmarks, landmarks_option
from scan2albedo.errors import ScanError
from scan2albedo.io.csv_tables import cells_by_column, read_text, table_rows
from scan2albedo.io.limits import parse_json

_ADVICE = (
    f"give rows of number (0 to {COUNT - 1}), x, y, z; a landmarks.json or landmarks.csv of `process`; or a "
    ".pp of MeshLab whose points have numbers as names"
)
_COLUMNS = (("scan_x", "scan_y", "scan_z"), ("x", "y", "z"))
_DEVIATIONS = ("sigma_mm", "deviation_mm")


@dataclass(frozen=True)
class _Point:
    """One point as the file has it, at a place in it that messages name."""

    where: str
    number: Any
    place: tuple[Any, ...]
    sigma_mm: Any = PLACED_SIGMA_MM


def read_landmarks(file: str | Path, mm_per_unit: float = 1.0) -> PlacedLandmarks:
    """Return the landmarks of a file, in mm; any subset of the 68, numbered from 0 in iBUG-68 order.

    - ``.csv``, ``.txt``: columns number, x, y, z (also scan_x, scan_y, scan_z, as `process` writes them) and
      where wanted sigma_mm; without a header the first four cells.
    - ``.json``: ``{"36": [x, y, z], ...}``, a list of 68 points with null for those not placed, or a
      `landmarks.json` of `process`.
    - ``.pp``: points picked with MeshLab, their names the numbers; inactive ones are left out.

    Raises ScanError that names the file and the place.

    Parameters
    ----------
    file : path
    mm_per_unit : float
        Of the scan that they were placed on: the points are in its file's frame and unit.
    """
    path = Path(file)
    readers: dict[str, Callable[[str, Path], Iterator[_Point]]] = {
        ".csv": _of_table,
        ".txt": _of_table,
        ".json": _of_json,
        ".pp": _of_picked_points,
    }
    if (reader := readers.get(path.suffix.lower())) is None:
        raise ScanError(f"{path}: landmarks are read from .csv, .json and .pp files; {_ADVICE}")
    text = read_text(path, what=f"landmarks {path}", advice=_ADVICE, error=ScanError)
    points, sigma_mm = np.full((COUNT, 3), np.nan), np.full(COUNT, PLACED_SIGMA_MM)
    seen: dict[int, str] = {}
    for point in reader(text, path):
        try:
            number = int(str(point.number))
        except ValueError:
            number = -1
        if not 0 <= number < COUNT:
            raise ScanError(
                f"{point.where}: {str(point.number)[:40]!r} is not the number of a landmark "
                f"(0 to {COUNT - 1}); {_ADVICE}"
            )
        if number in seen:
            raise ScanError(f"{point.where}: landmark {number} was given before ({seen[number]}); keep one")
        seen[number] = point.where
        points[number] = [_finite(point, value) * mm_per_unit for value in point.place]
        sigma_mm[number] = _finite(point, point.sigma_mm)
    try:
        return PlacedLandmarks(points, sigma_mm)
    except ScanError as error:
        raise ScanError(f"{path}: {error}") from error


def _finite(point: _Point, value: Any) -> float:
    try:
        found = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        found = math.nan
    if not math.isfinite(found):
        raise ScanError(f"{point.where}: {str(value)[:40]!r} is not a finite number; {_ADVICE}")
    return found


def _of_table(text: str, file: Path) -> Iterator[_Point]:
    rows = table_rows(text, file, ScanError)
    if not rows:
        return
    header = [cell.strip().lower() for cell in rows[0][1]]
    if "number" not in header:  # no header
        for line, row in rows:
            yield _Point(f"{file}, line {line}", row[0].strip(), _three(f"{file}, line {line}", row[1:4]))
        return
    columns = next((names for names in _COLUMNS if set(names) <= set(header)), None)
    if columns is None:
        raise ScanError(f"{file}: has no columns x, y and z; {_ADVICE}")
    deviation = next((name for name in _DEVIATIONS if name in header), "")
    for line, row in rows[1:]:
        where = f"{file}, line {line}"
        cells = cells_by_column(header, row, where, ScanError)
        place = tuple(cells[name] for name in columns)
        if any(place):  # a row without coordinates is a landmark that was not placed
            yield _Point(where, cells["number"].strip(), place, cells.get(deviation) or PLACED_SIGMA_MM)


def _of_json(text: str, file: Path) -> Iterator[_Point]:
    try:
        tree = parse_json(file.name, text.encode())
    except (ValueError, RecursionError) as error:
        raise ScanError(f"{file}: is no JSON ({error}); {_ADVICE}") from error
    listed = tree.get("landmarks", tree) if isinstance(tree, dict) else tree
    if isinstance(listed, dict):
        listed = [{"number": number, "scan": place} for number, place in listed.items()]
    if not isinstance(listed, list):
        raise ScanError(f"{file}: holds no landmarks; {_ADVICE}")
    for index, entry in enumerate(listed):
        where = f"{file}, landmark {index}"
        row = entry if isinstance(entry, dict) else {"number": index, "scan": entry}
        place = row.get("scan", row.get("point"))
        if place is not None:
            sigma_mm = row.get("deviation_mm", row.get("sigma_mm", PLACED_SIGMA_MM))
            yield _Point(where, row.get("number"), _three(where, place), sigma_mm)


def _of_picked_points(text: str, file: Path) -> Iterator[_Point]:
    try:
        tree = ElementTree.fromstring(text)
    except (ElementTree.ParseError, RecursionError) as error:
        raise ScanError(f"{file}: is not a file of picked points ({error}); {_ADVICE}") from error
    for index, point in enumerate(tree.iter("point")):
        if point.get("active", "1") != "0":
            place = tuple(point.get(axis) for axis in "xyz")
            yield _Point(f"{file}, point {index}", point.get("name"), place)


def _three(where: str, place: Any) -> tuple[Any, ...]:
    if not isinstance(place, list | tuple) or len(place) != 3:
        raise ScanError(f"{where}: {str(place)[:40]} are not three coordinates; {_ADVICE}")
    return tuple(place)


def landmarks_for(given: Any, scan: str | Path | None, mm_per_unit: float) -> PlacedLandmarks | None:
    """Return landmarks given as a file, a folder with a file named after the scan, or points in its unit.

    None where the folder holds none for the scan.
    """
    if not isinstance(given, str | Path):
        return PlacedLandmarks.of(given, mm_per_unit)
    if landmarks_option(given) == AUTO:
        raise ScanError(
            f"landmarks is {given!r}, which is an option of `process`: here, give a file or points"
        )
    file = landmarks_file(given, scan)
    return None if file is None else read_landmarks(file, mm_per_unit)


def landmarks_file(given: str | Path, scan: str | Path | None) -> Path | None:
    """Return the file of a scan's landmarks: the file given, or that of its stem in the folder given."""
    path = Path(given)
    if not path.is_dir():
        return path
    stem = "" if scan is None else Path(scan).stem
    found = (path / f"{stem}{extension}" for extension in (".csv", ".json", ".pp", ".txt"))
    return next((file for file in found if stem and file.is_file()), None)
