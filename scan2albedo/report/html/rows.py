"""One row a scan, from `catalogue.parquet` or `result.json`, and which of them get a section of their own."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date, datetime
from pathlib import Path
from typing import Any

from scan2albedo.errors import Scan2AlbedoError, needs_extra, one_line
from scan2albedo.io.records import read_record
from scan2albedo.io.result_records import ResultRecord, metric_columns

CATALOGUE_FILE, RESULT_FILE = "catalogue.parquet", "result.json"
_OWN_FIELDS = ("name", "status", "reason", "folder")
DONE, FAILED, NOT_RUN = "done", "failed", "not run"
RESIDUAL = "metrics_fit_residual_mean_mm"
COVERAGE = "metrics_fit_coverage"
UNCERTAINTY = "metrics_albedo_uncertainty_albedo_deviation"


@dataclass(frozen=True)
class ScanRow:
    """One scan of a batch: its `status` is "done", "failed" or "not run", `reason` why it is not done.

    `folder` holds its files; `values` are further columns, named as in `catalogue.parquet`: numbers, text,
    None.
    """

    name: str
    status: str
    reason: str = ""
    folder: Path | None = None
    values: Mapping[str, Any] = field(default_factory=dict)

    def number(self, column: str) -> float | None:
        """Return a finite number of a column, or None."""
        value = self.values.get(column)
        if isinstance(value, bool) or not isinstance(value, int | float):
            return None
        return float(value) if abs(value) < float("inf") else None


def result_folders(out: Path) -> list[Path]:
    """Return the folders in `out` that hold a result.json, by name; hidden ones do not count."""
    try:
        inside = sorted(path for path in out.iterdir() if path.is_dir() and not path.name.startswith("."))
    except OSError as error:
        raise Scan2AlbedoError(f"{out}: cannot be read: {error.strerror or error}") from error
    return [path for path in inside if (path / RESULT_FILE).is_file()]


def rows_of_folders(folders: list[Path]) -> list[ScanRow]:
    """Return a row for each folder; a result.json that cannot be read becomes a failure with that reason."""
    rows = []
    for folder in folders:
        try:
            record = read_record(folder / RESULT_FILE, ResultRecord)
        except Scan2AlbedoError as error:
            rows.append(ScanRow(folder.name, FAILED, one_line(error), folder))
        else:
            rows.append(row_of_record(record, folder))
    return rows


def row_of_record(record: ResultRecord, folder: Path) -> ScanRow:
    """Return the row of one result."""
    values: dict[str, Any] = {"source": record.input.file, "input_sha256": record.input.sha256}
    seconds = record.metrics.get("seconds")
    values["seconds"] = sum(record.timings_s.values()) if seconds is None else seconds
    values.update(metric_columns(record.metrics))
    values.update({f"seconds_{stage}": seconds for stage, seconds in record.timings_s.items()})
    for column, ran in (("plan_ran", True), ("plan_skipped", False)):
        rows = (step for step in record.plan if step.level not in ("doubt", "wrong"))
        values[column] = ", ".join(dict.fromkeys(step.stage for step in rows if step.ran is ran))
    return ScanRow(record.name, DONE, "", folder, values)


def rows_of_catalogue(file: Path) -> list[ScanRow]:
    """Return a row for each scan of a batch, in the order of its catalogue.

    MissingDependencyError without pyarrow; Scan2AlbedoError when the file cannot be read or has no names or
    no states, and names it.
    """
    table = _table(file)
    missing = [name for name in ("name", "status") if name not in table.column_names]
    if missing:
        raise Scan2AlbedoError(
            f"{file}: has no column {' and no column '.join(missing)}; it is no catalogue of a batch"
        )
    return [_row(entry, file.parent) for entry in table.to_pylist()]


def _table(file: Path) -> Any:
    with needs_extra("report"):
        import pyarrow
        from pyarrow import parquet
    try:
        return parquet.read_table(file)
    except (OSError, pyarrow.ArrowException) as error:
        first = one_line(error)[:200]
        raise Scan2AlbedoError(
            f"{file}: cannot be read as Parquet ({first}); run the batch again, or remove the file so that "
            "the table is made of the result.json files"
        ) from error


def _row(entry: Mapping[str, Any], out: Path) -> ScanRow:
    status = str(entry["status"] or NOT_RUN).replace("_", " ")
    values = {key: _plain(value) for key, value in entry.items() if key not in _OWN_FIELDS}
    folder = out / str(entry["folder"]) if entry.get("folder") else None
    reason = str(entry.get("reason") or "")
    if folder is not None and folder.parent != out:
        reason, folder = "the catalogue names a folder that is not in that of the batch", None
    if status == DONE and folder is not None and not (folder / RESULT_FILE).is_file():
        # The catalogue may be carried about without the folders; the row says so.
        reason, folder = reason or "its files are not here", None
    if status == FAILED:
        reason = reason or "no reason was recorded"
    return ScanRow(str(entry["name"]), status, reason, folder, values)


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


@dataclass(frozen=True)
class Selection:
    """Positions of the rows that are shown in full, and why these."""

    rows: tuple[int, ...]
    reason: str


def selected_rows(rows: Sequence[ScanRow], count: int) -> Selection:
    """Return the scans a person wants to see first: the worst, and two to compare them with.

    Of the scans that are done and have files, the worst by fit residual (by the albedo's uncertainty for
    objects without a fit), and the median and the best one. Failed scans have nothing to show.
    """
    there = [k for k, row in enumerate(rows) if row.status == DONE and row.folder is not None]
    if count >= len(there):
        return Selection(tuple(there), f"all {len(there)} scans that have results" if len(there) > 1 else "")
    if not count:
        return Selection((), "no scan, as asked for")
    column = RESIDUAL if any(rows[k].number(RESIDUAL) is not None for k in there) else UNCERTAINTY
    what = "fit residual" if column == RESIDUAL else "uncertainty of the albedo"
    known = [k for k in there if rows[k].number(column) is not None]
    ranked = sorted(known, key=lambda k: -(rows[k].number(column) or 0.0))
    ranked += [k for k in there if rows[k].number(column) is None]
    if not known:
        return Selection(tuple(ranked[:count]), f"the first {count} of {len(there)} scans that have results")
    if count < 4 or len(known) < count:
        chosen = ranked[:count]
        return Selection(tuple(chosen), f"the {count} scans of {len(there)} with the greatest {what}")
    compared = (ranked[len(known) // 2], ranked[len(known) - 1])
    worst = [k for k in ranked if k not in compared][: count - 2]
    text = f"the {count - 2} scans of {len(there)} with the greatest {what}, then the median and the best one"
    return Selection((*worst, *compared), text)
