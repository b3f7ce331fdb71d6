"""Results and the persons they show: a CSV file, or a folder of processed scans."""

from __future__ import annotations

import unicodedata
from dataclasses import dataclass
from pathlib import Path

from scan2albedo.errors import RecognitionError, needs_extra
from scan2albedo.io.csv_tables import cells_by_column, read_text, table_rows
from scan2albedo.io.result_records import APPLICATION_FILE

RESULT_FILE, CATALOGUE_FILE = "result.json", "catalogue.parquet"


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
    notes: tuple[str, ...] = ()
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
    that column, a person called SCAN.

    Every line has to name a person where `persons_required`.

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
        return any((of / name).is_file() for name in (RESULT_FILE, APPLICATION_FILE))

    def folders(of: Path) -> list[Path]:
        return sorted(path for path in of.iterdir() if path.is_dir() and not path.name.startswith("."))

    if holds_result(folder):
        raise RecognitionError(
            f"{folder}: is one result; give the folder that holds the folders of results, or a CSV file with "
            "the columns person and result"
        )

    # The persons of a batch's catalogue by the scan's name, where it has that column.
    named, catalogue = None, folder / CATALOGUE_FILE
    if catalogue.is_file():
        with needs_extra("batch"):
            import pyarrow
            import pyarrow.parquet as parquet

        try:
            if {"name", "person"} <= set(parquet.read_schema(catalogue).names):
                rows = parquet.read_table(catalogue, columns=["name", "person"]).to_pylist()
                named = {
                    row["name"]: unicodedata.normalize("NFC", (row["person"] or "").strip()) for row in rows
                }
        except (OSError, pyarrow.ArrowException) as error:
            raise RecognitionError(
                f"{catalogue}: cannot be read ({error}); move it away, or repair the batch"
            ) from error
    entries = []
    for first in folders(folder):
        if holds_result(first):
            person = first.name if named is None else named.get(first.name)
            entries.append(ManifestEntry(person or None, first.name, first))
            continue
        for second in filter(holds_result, folders(first)):
            entries.append(ManifestEntry(first.name, f"{first.name}/{second.name}", second))
    if not entries:
        raise RecognitionError(
            f"{folder}: holds no folder of a processed scan, neither SCAN nor PERSON/SCAN; process scans "
            "with -o, or give a CSV file"
        )
    if persons_required and (nameless := [entry.result for entry in entries if entry.person is None]):
        raise RecognitionError(
            f"{catalogue}: names no person for {', '.join(nameless[:5])}; fill the column "
            "person of the batch's manifest"
        )
    return Manifest(folder, tuple(entries))
