"""The table of a batch from its `catalogue.parquet`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from datetime import date, datetime
from pathlib import Path
from typing import Any

from scan2albedo.errors import MissingDependencyError, Scan2AlbedoError
from scan2albedo.report.html.rows import DONE, FAILED, NOT_RUN, RESULT_FILE, ScanRow

CATALOGUE_FILE = "catalogue.parquet"
_OWN_FIELDS = ("name", "status", "reason", "folder")


def rows_of_catalogue(file: Path) -> list[ScanRow]:
    """Return a row for each scan of a batch, in the order of its catalogue.

    Raises
    ------
    MissingDependencyError
        Without pyarrow.
    Scan2AlbedoError
        When the file cannot be read or has no names or no states; the message names it.
    """
    table = _table(file)
    missing = [name for name in ("name", "status") if name not in table.column_names]
    if missing:
        raise Scan2AlbedoError(
            f"{file}: has no column {' and no column '.join(missing)}; it is no catalogue of a batch"
        )
    return [_row(entry, file.parent) for entry in table.to_pylist()]


def _table(file: Path) -> Any:
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise MissingDependencyError(
            f"{file} cannot be read without pyarrow; mend it with: pip install pyarrow"
        ) from error
    try:
        return parquet.read_table(file)
    except (OSError, pyarrow.ArrowException) as error:
        first = " ".join(str(error).split())[:200]
        raise Scan2AlbedoError(
            f"{file}: cannot be read as Parquet ({first}); run the batch again, or remove the file so that "
            "the table is made of the result.json files"
        ) from error


def _row(entry: Mapping[str, Any], out: Path) -> ScanRow:
    status = str(entry["status"] or NOT_RUN).replace("_", " ")
    values = {key: _plain(value) for key, value in entry.items() if key not in _OWN_FIELDS}
    folder = out / str(entry["folder"]) if entry.get("folder") else None
    reason = str(entry.get("reason") or "")
    if status == DONE and folder is not None and not (folder / RESULT_FILE).is_file():
        # The catalogue may be carried about without the folders; the row says so.
        reason, folder = reason or "its files are not here", None
    return ScanRow(str(entry["name"]), status, reason or _without_reason(status), folder, values)


def _without_reason(status: str) -> str:
    return "no reason was recorded" if status == FAILED else ""


def _plain(value: Any) -> Any:
    """Return a number, text, bool or None."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, datetime):
        return value.isoformat(" ", "seconds")
    if isinstance(value, date):
        return value.isoformat()
    if isinstance(value, list | tuple):
        return ", ".join(str(part) for part in value)
    if value is None or isinstance(value, bool | int | float | str):
        return value
    return str(value)
