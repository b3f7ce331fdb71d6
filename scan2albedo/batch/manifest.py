"""Manifests: which scans a batch processes, under what names."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from scan2albedo.batch.records import is_taken
from scan2albedo.core.arrays import Texts
from scan2albedo.core.landmarks import AUTO
from scan2albedo.core.raw_scan import is_folder_name, scan_name
from scan2albedo.errors import BatchError, errors_of, printable
from scan2albedo.io.csv_tables import cells_by_column, read_text, table_rows
from scan2albedo.io.load_scan import SUPPORTED_SCANS
from scan2albedo.pipeline.options import ProcessOptions

SCAN, PERSON = "scan", "person"
OWN_OPTIONS = ("unit", "model", "lights", "seed", "landmarks")
"""Columns that stand for an option of `process` in their line; an empty cell means the batch's choice."""


@dataclass(frozen=True)
class ManifestScan:
    """One scan of a manifest, or all scans of one person, its `members`.

    `name` is of the folder of its result, `source` the path as the manifest has it, `path` absolute; `own`
    are options of `OWN_OPTIONS` that the line sets, `extra` the cells of all other columns, `where` is the
    place in the manifest, for messages. `source` and `extra` are `printable`. A person has the `path` of the
    first scan, and the sources and cells of all.
    """

    name: str
    source: str
    path: Path
    own: Mapping[str, str] = field(default_factory=dict)
    extra: Mapping[str, str] = field(default_factory=dict)
    where: str = ""
    members: tuple[ManifestScan, ...] = ()

    def options(self, batch: ProcessOptions, folder: Path) -> ProcessOptions:
        """Return the batch's options with the line's, paths from `folder`; BatchError for a wrong cell."""
        cells: dict[str, Any] = {name: text for name, text in self.own.items() if text}
        with errors_of(self.where, BatchError, ValueError):
            chosen = replace(batch, **cells)
        if "model" in cells and cells["model"] not in ("default", "none"):
            chosen = replace(chosen, model=str((folder / cells["model"]).absolute()))
        if "landmarks" in cells and chosen.landmarks != AUTO:
            chosen = replace(chosen, landmarks=str((folder / cells["landmarks"]).absolute()))
        return chosen


@dataclass(frozen=True)
class BatchManifest:
    """The `scans` of a batch, one or more, no two of one name, in the order of the file or folder `path`."""

    path: Path
    scans: tuple[ManifestScan, ...]
    extra_columns: Texts = ()
    """Of the table, beside those with a meaning here."""

    @property
    def folder(self) -> Path:
        """Folder from which relative paths start."""
        return (self.path if self.path.is_dir() else self.path.parent).absolute()


def read_manifest(
    path: str | Path, *, leave_out: Path | None = None, name_columns: Texts = ()
) -> BatchManifest:
    """Return the scans of a manifest: of a table, a list of paths, or a folder; one need not exist.

    - ``.csv`` or ``.tsv``, UTF-8: the column `scan` (a path, relative to the file), and where wanted `name`
      (of the result's folder; the scan's stem when empty), `unit`, `model`, `lights`, `seed`, `landmarks`,
      and `person`: scans of one are processed together, into a folder of that name.
      Cells of other columns are kept as they are.
    - Any other text file: one path a line; empty lines, and lines that begin with #, are left aside.
    - A folder: every scan in it and its subfolders, except hidden ones and results of earlier runs.

    Raises BatchError when it is missing, at fault or empty, or two scans have one name, with the lines.

    Parameters
    ----------
    path : path
    leave_out : path, optional
        Folder to skip: that of the results.
    name_columns : tuple of str
        Columns of a table whose cells stand before the name of results that would have one name. With
        `person` among them, scans stay apart.
    """
    source = Path(path)
    if source.is_dir():
        found, out = list[Path](), None if leave_out is None else leave_out.resolve()
        for place, folders, files in os.walk(source):
            folders[:] = [f for f in folders if not f.startswith(".") and Path(place, f).resolve() != out]
            if "batch.json" in files:
                folders.clear()
            elif "result.json" not in files:
                scans_here = [f for f in files if Path(f).suffix.lower() in SUPPORTED_SCANS and f[0] != "."]
                found += [Path(place, file) for file in scans_here]
        scans = [_scan(str(f.relative_to(source)), source, where=str(f)) for f in sorted(found)]
        manifest = BatchManifest(source, tuple(scans))
    elif source.suffix.lower() in SUPPORTED_SCANS:
        raise BatchError(f"{source}: is a scan; give a CSV file, a list of paths or a folder of scans")
    else:
        advice = f"give a CSV file with a column {SCAN!r}, a list of paths or a folder"
        text = read_text(source, what=f"manifest {source}", advice=advice, error=BatchError)
        if source.suffix.lower() in (".csv", ".tsv"):
            manifest = _of_table(source, text, name_columns)
        else:
            lines = [(f"{source}, line {k}", line.strip()) for k, line in enumerate(text.splitlines(), 1)]
            wanted = [(where, line) for where, line in lines if line and not line.startswith("#")]
            scans = [_scan(line, source.parent.absolute(), where=where) for where, line in wanted]
            manifest = BatchManifest(source, tuple(scans))
    if not manifest.scans:
        kinds = f" ({', '.join(SUPPORTED_SCANS)})" if source.is_dir() else ""
        raise BatchError(f"{source} lists no scan{kinds}; nothing to do")
    for together in (manifest.scans, *(scan.members for scan in manifest.scans)):
        first: dict[str, ManifestScan] = {}
        for scan in together:
            if not is_folder_name(scan.name):
                raise BatchError(
                    f"{scan.where}: {scan.name!r} cannot name a result folder; give another name"
                )
            other = first.setdefault(scan.name.casefold(), scan)
            if other is not scan:
                raise BatchError(
                    f"{other.where} and {scan.where}: both results would be named {scan.name}; give other "
                    "names (a CSV file with a column `name` can)"
                )
    return manifest


def _scan(source: str, folder: Path, *, where: str, name: str = "", **more: Any) -> ManifestScan:
    path = Path(os.path.normpath((folder / source).absolute()))
    return ManifestScan(name or scan_name(path), printable(source), path, where=where, **more)


def _of_table(file: Path, text: str, name_columns: Texts) -> BatchManifest:
    rows = table_rows(text, file, BatchError)
    known = (SCAN, "name", *OWN_OPTIONS)
    names = [printable(cell.strip()) for cell in (rows[0][1] if rows else [])]
    header = [name.lower() if name.lower() in known else name for name in names]
    if SCAN not in header:
        found = f"its first line has {', '.join(header)}" if header else "it is empty"
        raise BatchError(f"{file} lacks the column {SCAN} ({found}); begin it with a header like scan,name")
    folded = [name.casefold() for name in header]
    if twice := [name for name in header if folded.count(name.casefold()) > 1]:
        raise BatchError(f"{file} has the column {twice[0] or 'without a name'} twice; rename one")
    if "" in header:
        raise BatchError(f"{file}: column {header.index('') + 1} has no name; give it one")
    if taken := [name for name in header if name not in known and is_taken(name)]:
        raise BatchError(f"{file}: the catalogue has a column {taken[0]} of its own; rename it")
    extra = tuple(name for name in header if name not in known)
    scans = []
    for line, row in rows[1:]:
        where = f"{file}, line {line}"
        cells = cells_by_column(header, row, where, BatchError)
        if not (source := cells[SCAN].strip()):
            raise BatchError(f"{where}: names no scan")
        own = {name: cells[name].strip() for name in OWN_OPTIONS if name in cells}
        kept = {name: printable(cells[name]) for name in extra}
        name = cells.get("name", "").strip()
        scans.append(_scan(source, file.parent.absolute(), where=where, name=name, own=own, extra=kept))
    # Scans of one name get their cells of some columns before it.
    count = Counter(scan.name.casefold() for scan in scans)
    for k, scan in enumerate(scans):
        if count[scan.name.casefold()] > 1:
            before = [text.strip() for title, text in scan.extra.items() if title.casefold() in name_columns]
            scans[k] = replace(scan, name="-".join((*before, scan.name)))
    column = next((name for name in extra if name.casefold() == PERSON), None)
    if column is not None and PERSON not in name_columns:
        scans = _joined(scans, column)
    return BatchManifest(file, tuple(scans), extra)


def _joined(scans: list[ManifestScan], column: str) -> list[ManifestScan]:
    """Return the scans, those of one person as one, by the cells of a column; others stay alone."""
    together: dict[str | int, list[ManifestScan]] = {}
    for k, scan in enumerate(scans):
        together.setdefault(scan.extra[column].strip() or k, []).append(scan)
    for k, (person, members) in enumerate(together.items()):
        first = members[0]
        if other := next((scan for scan in members if scan.own != first.own), None):
            raise BatchError(
                f"{first.where} and {other.where}: scans of one person with other options; give all of "
                f"them the same {', '.join(other.own)}"
            )
        scans[k] = first
        if isinstance(person, str):
            sources = ", ".join(scan.source for scan in members)
            cells = {
                name: "; ".join(dict.fromkeys(scan.extra[name] for scan in members)) for name in first.extra
            }
            scans[k] = replace(first, name=person, source=sources, extra=cells, members=tuple(members))
    return scans[: len(together)]
