"""The page's section about a batch: one row a scan, its table, distributions, and which scans come first."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from scan2albedo.core.arrays import Values
from scan2albedo.errors import Scan2AlbedoError, needs_extra, one_line
from scan2albedo.io.records import read_record
from scan2albedo.io.result_records import ResultRecord, metric_columns
from scan2albedo.report.html.scan_section import relative_link
from scan2albedo.report.html.texts import label_of, number_text, seconds_text, unit_of, value_text

CATALOGUE_FILE, RESULT_FILE = "catalogue.parquet", "result.json"
DONE, FAILED, NOT_RUN = "done", "failed", "not run"
RESIDUAL = "metrics_fit_residual_mean_mm"
COVERAGE = "metrics_fit_coverage"
UNCERTAINTY = "metrics_albedo_uncertainty_albedo_deviation"
FIGURES = (
    *(RESIDUAL, COVERAGE, "metrics_geometry_image_seen", "metrics_fit_residual_p95_mm"),
    *("metrics_registration_rmse_mm", "metrics_registration_confidence", "metrics_albedo_lights"),
    *(UNCERTAINTY, "seconds", "cpu_seconds", "peak_memory_mb"),
)
"""Columns of the table and distributions, where the batch has them."""
_SHOWN_ELSEWHERE = {
    "source",
    "input_sha256",
    "options_sha256",
    "worker",
    "finished_at",
    "plan_ran",
    "plan_skipped",
    "notes",
}
_BATCH_PREFIXES = ("metrics_", "seconds_", "path_")
_LONGEST_LIST = 8


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


def rows_of_folders(out: Path) -> list[ScanRow]:
    """Return a row for each folder in `out` that holds a result.json, by name; hidden ones do not count.

    A result.json that cannot be read becomes a failure with that reason; Scan2AlbedoError when there is none.
    """
    try:
        inside = sorted(path for path in out.iterdir() if path.is_dir() and not path.name.startswith("."))
    except OSError as error:
        raise Scan2AlbedoError(f"{out}: cannot be read: {error.strerror or error}") from error
    folders = [path for path in inside if (path / RESULT_FILE).is_file()]
    if not folders:
        raise Scan2AlbedoError(f"{out}: holds no {RESULT_FILE} and no {CATALOGUE_FILE}; process scans first")
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
    values: Values = {"source": record.input.file, "input_sha256": record.input.sha256}
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
    with needs_extra("report"):
        import pyarrow
        from pyarrow import parquet
    try:
        table = parquet.read_table(file)
    except (OSError, pyarrow.ArrowException) as error:
        first = one_line(error)[:200]
        raise Scan2AlbedoError(
            f"{file}: cannot be read as Parquet ({first}); run the batch again, or remove the file so that "
            "the table is made of the result.json files"
        ) from error
    missing = [name for name in ("name", "status") if name not in table.column_names]
    if missing:
        raise Scan2AlbedoError(f"{file}: has no column {' and no column '.join(missing)}; it is no catalogue")
    rows = []
    for entry in table.to_pylist():
        status = str(entry["status"] or NOT_RUN).replace("_", " ")
        folder = file.parent / str(entry["folder"]) if entry.get("folder") else None
        reason = str(entry.get("reason") or "")
        if folder is not None and folder.parent != file.parent:
            reason, folder = "the catalogue names a folder that is not in that of the batch", None
        if status == DONE and folder is not None and not (folder / RESULT_FILE).is_file():
            # The catalogue may be carried about without the folders; the row says so.
            reason, folder = reason or "its files are not here", None
        if status == FAILED:
            reason = reason or "no reason was recorded"
        own = ("name", "status", "reason", "folder")
        values = {key: value for key, value in entry.items() if key not in own}
        for key, value in values.items():
            if isinstance(value, float) and not math.isfinite(value):
                values[key] = None
            elif isinstance(value, datetime):
                values[key] = value.isoformat(" ", "seconds")
            elif isinstance(value, list | tuple):
                values[key] = ", ".join(map(str, value))
            elif not isinstance(value, bool | int | float | str | None):
                values[key] = str(value)
        rows.append(ScanRow(str(entry["name"]), status, reason, folder, values))
    return rows


def selected_rows(rows: Sequence[ScanRow], count: int) -> tuple[tuple[int, ...], str]:
    """Return which scans a person wants to see first, and why these.

    Of the scans that are done and have files, the worst by fit residual (by the albedo's uncertainty for
    objects without a fit). Failed scans have nothing to show.
    """
    there = [k for k, row in enumerate(rows) if row.status == DONE and row.folder is not None]
    if count >= len(there):
        return tuple(there), f"all {len(there)} scans that have results" if len(there) > 1 else ""
    fitted = any(rows[k].number(RESIDUAL) is not None for k in there)
    column = RESIDUAL if fitted else UNCERTAINTY
    worst = sorted(there, key=lambda k: -(rows[k].number(column) or 0.0))
    return tuple(worst[:count]), f"{count} of {len(there)} scans, the worst by {label_of(column)}"


def batch_section(
    rows: Sequence[ScanRow], anchors: Mapping[int, str], page: Path, most_rows: int = 10_000
) -> Values:
    """Return the section about a batch, as the template shows it, for the page at `page`.

    `anchors` maps the positions of rows with a section to its anchor. The table has at most `most_rows`, for
    browsers become slow beyond; scans that failed go first when there are more.
    """
    shown: Sequence[int] = range(len(rows))
    if len(rows) > most_rows:
        order = sorted(shown, key=lambda k: (rows[k].status == DONE, k not in anchors, k))
        shown = sorted(order[:most_rows])
    reasons = Counter(row.reason for row in rows if row.status == FAILED).most_common()
    counts = Counter(row.status for row in rows)
    states = dict.fromkeys((DONE, FAILED, NOT_RUN, *counts))
    done = [row for row in rows if row.status == DONE]

    def link(k: int) -> str:
        """Return the link to a scan's section, else to its folder, else ""."""
        if k in anchors:
            return f"#{anchors[k]}"
        folder = rows[k].folder
        return "" if folder is None or not folder.is_dir() else relative_link(folder, page)

    columns, table = _columns(rows, done), []
    for k in shown:
        row, cells = rows[k], []
        for name in columns:
            # What is shown of a column, and what it is sorted by.
            value, number = row.values.get(name), row.number(name)
            text = "" if value is None else value_text(name if name in FIGURES else "", value)
            cells.append({"text": text, "key": text if number is None else repr(number)})
        table.append(
            {"name": row.name, "status": row.status, "reason": row.reason, "link": link(k), "cells": cells}
        )
    return {
        "counts": {state: counts[state] for state in states if counts[state] or state == DONE},
        "total": len(rows),
        "facts": _facts(rows),
        "reasons": reasons[:_LONGEST_LIST],
        "more_reasons": max(len(reasons) - _LONGEST_LIST, 0),
        "columns": list(columns.values()),
        "rows": table,
        "rows_left_out": len(rows) - len(shown),
        "distributions": _distributions(done),
    }


def _columns(rows: Sequence[ScanRow], done: Sequence[ScanRow]) -> dict[str, Values]:
    """Return the table's columns by name: figures that any scan has, then the user's own in their order."""
    names = list(dict.fromkeys(name for row in rows for name in row.values))
    left_out = {*FIGURES, *_SHOWN_ELSEWHERE}
    if len({row.values.get("model") for row in done}) == 1:
        left_out.add("model")
    own = [name for name in names if name not in left_out and not name.startswith(_BATCH_PREFIXES)]
    figures = [name for name in FIGURES if any(row.number(name) is not None for row in rows)]
    columns = {}
    for name in (*figures, *own):
        known = [row for row in rows if row.values.get(name) is not None]
        numeric = bool(known) and all(row.number(name) is not None for row in known)
        unit = unit_of(name) if name in figures else ""
        columns[name] = {"name": name, "label": label_of(name), "unit": unit, "numeric": numeric}
    return columns


def _distributions(rows: Sequence[ScanRow]) -> list[Values]:
    """Return a histogram of each figure that several scans have: heights of bars, as parts of the highest."""
    histograms = []
    for column in FIGURES:
        known = [value for row in rows if (value := row.number(column)) is not None]
        if len(known) > 1:
            counts, edges = np.histogram(known, bins="sturges")
            low, median, high = float(edges[0]), float(np.median(known)), float(edges[-1])
            texts = [value_text(column, value) for value in (low, median, high)]
            title = f"{label_of(column)}, median {texts[1]} {unit_of(column)}"
            place, bars = (median - low) / (high - low), (counts / counts.max()).tolist()
            histograms.append({"title": title, "bars": bars, "median": place, "ends": texts[::2]})
    return histograms


def _facts(rows: Sequence[ScanRow]) -> list[tuple[str, str]]:
    """Return (label, value) of the figures of the whole batch."""
    seconds, cpu, memory = (
        [number for row in rows if (number := row.number(column)) is not None]
        for column in ("seconds", "cpu_seconds", "peak_memory_mb")
    )
    facts = []
    if seconds:
        facts.append(("time of all scans", seconds_text(sum(seconds))))
        facts.append(("a scan, mean", seconds_text(sum(seconds) / len(seconds))))
    if cpu:
        facts.append(("CPU time", seconds_text(sum(cpu))))
    if memory:
        facts.append(("greatest memory", f"{number_text(max(memory))} MB"))
    return facts
