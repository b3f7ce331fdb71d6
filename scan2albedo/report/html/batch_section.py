"""The page's section about a batch: its summary, table, distributions, and its slowest and worst scans."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from scan2albedo.report.html.charts import Histogram, histogram
from scan2albedo.report.html.rows import COVERAGE, DONE, FAILED, NOT_RUN, RESIDUAL, UNCERTAINTY, ScanRow
from scan2albedo.report.html.scan_section import relative_link
from scan2albedo.report.html.texts import label_of, number_text, seconds_text, unit_of, value_text

FIGURES = (
    RESIDUAL,
    COVERAGE,
    "metrics_geometry_image_seen",
    "metrics_fit_residual_p95_mm",
    "metrics_registration_rmse_mm",
    "metrics_registration_confidence",
    "metrics_albedo_lights",
    UNCERTAINTY,
    "seconds",
    "cpu_seconds",
    "peak_memory_mb",
)
"""Columns of the table and distributions, where the batch has them."""
_SHOWN_ELSEWHERE = {
    "source", "input_sha256", "options_sha256", "worker", "finished_at", "plan_ran", "plan_skipped",
    "notes",
}  # fmt: skip
_BATCH_PREFIXES = ("metrics_", "seconds_", "path_")
_EXTREMES = (
    ("seconds", "Slowest", -1),
    (RESIDUAL, "Worst fits", -1),
    (COVERAGE, "Least scanned", 1),
    (UNCERTAINTY, "Least certain albedos", -1),
)
"""Column, title, and whether the greatest (-1) or the least (1) come first."""
_MOST_EXTREME, _MOST_REASONS = 6, 12


@dataclass(frozen=True)
class Cell:
    """One cell of the table: what is shown, and what it is sorted by."""

    text: str
    key: str


@dataclass(frozen=True)
class TableRow:
    """One scan in the table."""

    name: str
    status: str
    reason: str
    link: str
    """To its section, else to its folder, else ""."""
    cells: tuple[Cell, ...]


@dataclass(frozen=True)
class Column:
    """One column of the table."""

    name: str
    label: str
    unit: str
    numeric: bool


@dataclass(frozen=True)
class Extremes:
    """The scans that are greatest in a column: (name, value with unit, link)."""

    title: str
    rows: tuple[tuple[str, str, str], ...]


@dataclass(frozen=True)
class BatchSection:
    """A batch as the template shows it."""

    counts: Mapping[str, int]
    total: int
    facts: tuple[tuple[str, str], ...]
    reasons: tuple[tuple[str, int], ...]
    more_reasons: int
    columns: tuple[Column, ...]
    rows: tuple[TableRow, ...]
    rows_left_out: int
    histograms: tuple[Histogram, ...]
    extremes: tuple[Extremes, ...]


def batch_section(
    rows: Sequence[ScanRow], anchors: Mapping[int, str], page: Path, most_rows: int
) -> BatchSection:
    """Return the section about a batch for the page at `page`.

    `anchors` maps the positions of rows with a section to its anchor. The table has at most `most_rows`;
    scans that failed go first when there are more.
    """
    columns = _columns(rows)
    shown = range(len(rows))
    if len(rows) > most_rows:
        first = sorted(shown, key=lambda k: (rows[k].status == DONE, k not in anchors, k))[:most_rows]
        shown = sorted(first)  # type: ignore[assignment]
    reasons = Counter(row.reason for row in rows if row.status == FAILED).most_common()
    counts = Counter(row.status for row in rows)
    states = dict.fromkeys((DONE, FAILED, NOT_RUN, *counts))
    return BatchSection(
        counts={s: counts[s] for s in states if counts[s] or s == DONE},
        total=len(rows),
        facts=_facts(rows),
        reasons=tuple(reasons[:_MOST_REASONS]),
        more_reasons=max(len(reasons) - _MOST_REASONS, 0),
        columns=columns,
        rows=tuple(_table_row(rows[k], columns, anchors.get(k), page) for k in shown),
        rows_left_out=len(rows) - len(shown),
        histograms=_histograms(rows),
        extremes=_extremes(rows, anchors, page),
    )


def _columns(rows: Sequence[ScanRow]) -> tuple[Column, ...]:
    """Return the figures that any scan has, then the user's own columns in their order."""
    names = list(dict.fromkeys(name for row in rows for name in row.values))
    own = [
        name
        for name in names
        if name not in FIGURES and name not in _SHOWN_ELSEWHERE and not name.startswith(_BATCH_PREFIXES)
    ]
    if len({row.values.get("model") for row in rows if row.status == DONE}) == 1:
        own = [name for name in own if name != "model"]
    figures = [name for name in FIGURES if any(row.number(name) is not None for row in rows)]
    return tuple(
        Column(name, label_of(name), unit_of(name) if name in figures else "", _is_numeric(name, rows))
        for name in (*figures, *own)
    )


def _is_numeric(name: str, rows: Sequence[ScanRow]) -> bool:
    known = [row for row in rows if row.values.get(name) is not None]
    return bool(known) and all(row.number(name) is not None for row in known)


def _table_row(row: ScanRow, columns: Sequence[Column], anchor: str | None, page: Path) -> TableRow:
    cells = tuple(_cell(row, column) for column in columns)
    return TableRow(row.name, row.status, row.reason, _link(row, anchor, page), cells)


def _link(row: ScanRow, anchor: str | None, page: Path) -> str:
    if anchor is not None:
        return f"#{anchor}"
    return "" if row.folder is None or not row.folder.is_dir() else relative_link(row.folder, page)


def _cell(row: ScanRow, column: Column) -> Cell:
    value = row.values.get(column.name)
    text = "" if value is None else value_text(column.name if column.name in FIGURES else "", value)
    number = row.number(column.name)
    return Cell(text, text if number is None else repr(number))


def _histograms(rows: Sequence[ScanRow]) -> tuple[Histogram, ...]:
    done = [row for row in rows if row.status == DONE]
    made = [histogram(column, [row.number(column) for row in done]) for column in FIGURES]
    return tuple(chart for chart in made if chart is not None)


def _extremes(rows: Sequence[ScanRow], anchors: Mapping[int, str], page: Path) -> tuple[Extremes, ...]:
    lists = []
    for column, title, order in _EXTREMES:
        known = [k for k, row in enumerate(rows) if row.status == DONE and row.number(column) is not None]
        known.sort(key=lambda k: order * (rows[k].number(column) or 0.0))
        if len(known) > 1:
            shown = [
                (rows[k].name, _with_unit(rows[k], column), _link(rows[k], anchors.get(k), page))
                for k in known[:_MOST_EXTREME]
            ]
            lists.append(Extremes(title, tuple(shown)))
    return tuple(lists)


def _with_unit(row: ScanRow, column: str) -> str:
    if column == "seconds":
        return seconds_text(row.number(column))
    return f"{value_text(column, row.values[column])} {unit_of(column)}"


def _facts(rows: Sequence[ScanRow]) -> tuple[tuple[str, str], ...]:
    """Return (label, value) of the figures of the whole batch."""
    done = sum(row.status == DONE for row in rows)
    facts = []
    seconds = [s for row in rows if (s := row.number("seconds")) is not None]
    if seconds:
        facts.append(("time of all scans", seconds_text(sum(seconds))))
        facts.append(("a scan, mean", seconds_text(sum(seconds) / len(seconds))))
    cpu = [s for row in rows if (s := row.number("cpu_seconds")) is not None]
    if cpu:
        facts.append(("CPU time", seconds_text(sum(cpu))))
    span = _span_seconds(rows)
    if span and done:
        facts.append(("from first start to last end", seconds_text(span)))
        facts.append(("throughput", f"{number_text(3600 * done / span)} scans/h"))
    workers = {row.values["worker"] for row in rows if row.values.get("worker") is not None}
    if workers:
        facts.append(("workers", str(len(workers))))
    memory = [m for row in rows if (m := row.number("peak_memory_mb")) is not None]
    if memory:
        facts.append(("greatest memory", f"{number_text(max(memory))} MB"))
    return tuple(facts)


def _span_seconds(rows: Sequence[ScanRow]) -> float | None:
    """Return the seconds from the first start to the last end, where the catalogue holds both."""
    ends, starts = [], []
    for row in rows:
        end, seconds = _timestamp(row.values.get("finished_at")), row.number("seconds")
        if end is not None and seconds is not None:
            ends.append(end)
            starts.append(end - seconds)
    return max(ends) - min(starts) if ends else None


def _timestamp(value: object) -> float | None:
    if isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    try:
        return datetime.fromisoformat(str(value)).timestamp()
    except ValueError:
        return None
