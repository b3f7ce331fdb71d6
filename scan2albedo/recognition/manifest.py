"""CSV files of results and the persons they show."""

from __future__ import annotations

import csv
import unicodedata
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

from scan2albedo.errors import RecognitionError

COLUMNS = ("person", "result")
_DELIMITERS = ",;\t"
_UTF16 = (b"\xff\xfe", b"\xfe\xff")


@dataclass(frozen=True)
class ManifestEntry:
    """One line of a manifest."""

    person: str | None
    """Who is shown; None where the cell is empty."""
    result: str
    """As written in the file."""
    path: Path
    """The result itself; relative ones lie in the folder of the file."""
    line: int
    """Number of the line in the file."""


@dataclass(frozen=True)
class Manifest:
    """The entries of a CSV file, one or more."""

    file: Path
    entries: tuple[ManifestEntry, ...]
    """`file`, `entries`: the file, and its lines in order."""
    notes: tuple[str, ...] = ()
    """What is odd about them, one sentence each."""

    def where(self, entry: ManifestEntry) -> str:
        """Return file, line and result of an entry, for messages."""
        return f"{self.file}, line {entry.line}: {entry.result}"


def read_manifest(path: str | Path, *, persons_required: bool = True) -> Manifest:
    """Return the entries of a CSV file with the columns `person` and `result`.

    UTF-8 with or without a byte order mark; the header shows whether commas, semicolons or tabs separate
    cells. Other columns and empty lines are ignored.

    Parameters
    ----------
    path : path
    persons_required : bool
        Whether every line has to name a person.

    Raises
    ------
    RecognitionError
        When the file is missing, no text, lacks a column or has no entry; when an entry lacks person or
        result, a result does not exist or is named with two persons. Names file and line.
    """
    file = Path(path)
    header, rows = _table(_text(file), file)
    entries = tuple(_entry(file, header, line, row, persons_required) for line, row in rows)
    if not entries:
        raise RecognitionError(f"{file} has no entry below its header; add lines of person and result")
    return Manifest(file, entries, _repeated(file, entries))


def _text(file: Path) -> str:
    try:
        data = file.read_bytes()
    except OSError as error:
        raise RecognitionError(
            f"{file} cannot be read ({error.strerror or error}); give a CSV file with the columns "
            f"{' and '.join(COLUMNS)}"
        ) from error
    if data.startswith(_UTF16):
        raise RecognitionError(f"{file} is UTF-16 text; save it as CSV in UTF-8")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise RecognitionError(
            f"{file} is no UTF-8 text (byte {error.start} is {data[error.start]:#04x}); save it as CSV in "
            "UTF-8"
        ) from error
    if "\0" in text:
        raise RecognitionError(f"{file} is no text file; give a CSV file")
    return text


def _table(text: str, file: Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Return the header, in lower case, and the other rows that hold something, with their line numbers."""
    first = next((line for line in text.splitlines() if line.strip()), "")
    delimiter = max(_DELIMITERS, key=first.count)
    reader = csv.reader(StringIO(text, newline=""), delimiter=delimiter, strict=True)
    rows = []
    try:
        for row in reader:
            if any(cell.strip() for cell in row):
                rows.append((reader.line_num, [cell.strip() for cell in row]))
    except csv.Error as error:
        raise RecognitionError(f"{file}, line {reader.line_num}: {error}; mend its quotes") from error
    header = [cell.lower() for cell in rows[0][1]] if rows else []
    if missing := [name for name in COLUMNS if name not in header]:
        found = f"its first line has {', '.join(rows[0][1])}" if rows else "it is empty"
        raise RecognitionError(
            f"{file} lacks the column{'s' * (len(missing) > 1)} {' and '.join(missing)} ({found}); begin it "
            f"with a header of {','.join(COLUMNS)}"
        )
    return header, rows[1:]


def _entry(file: Path, header: list[str], line: int, row: list[str], persons_required: bool) -> ManifestEntry:
    if len(row) > len(header):
        raise RecognitionError(
            f"{file}, line {line}: has {len(row)} cells, the header {len(header)}; put a cell that holds a "
            "separator in quotes"
        )
    cells = dict(zip(header, row, strict=False))
    person = unicodedata.normalize("NFC", cells.get("person", ""))
    result = cells.get("result", "")
    if not result:
        raise RecognitionError(f"{file}, line {line}: names no result; give the folder of a processed scan")
    if persons_required and not person:
        raise RecognitionError(f"{file}, line {line}: {result} has no person; name who is shown")
    path = file.parent / result
    if not path.exists():
        raise RecognitionError(
            f"{file}, line {line}: {result}: no such folder or file; relative paths start from {file.parent}"
        )
    return ManifestEntry(person or None, result, path, line)


def _repeated(file: Path, entries: tuple[ManifestEntry, ...]) -> tuple[str, ...]:
    """Return notes on results that are named twice; two persons for one result are an error."""
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
    return tuple(notes)
