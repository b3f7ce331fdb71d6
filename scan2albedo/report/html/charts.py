"""Charts of the page: axes and ticks, distributions of a batch's figures, error against time of a stage."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scan2albedo.core import TraceRow
from scan2albedo.errors import Scan2AlbedoError
from scan2albedo.report.html.texts import is_share, label_of, number_text, unit_of

_ROOM = 0.04
"""Beyond the outermost values, in parts of their span."""
_LEAST_SPAN = 0.002
"""Of an axis, in parts of its greatest value."""
_STEPS = (1.0, 2.0, 2.5, 5.0, 10.0)
_BINS, _MOST_WHOLE = 20, 12
"""Bars of a distribution at most; up to which range whole numbers get a bar each."""
_LOG_VALUES, _LOG_ERROR, _LOG_TIME = 50.0, 5.0, 50.0
"""Ratios of greatest to least from which an axis is logarithmic."""
MOST_POINTS = 400
"""Points that a chart of 300 pixels can show; of more, every n-th."""


@dataclass(frozen=True)
class Axis:
    """Values from `low` to `high` along `start` to `end` in the drawing's unit."""

    low: float
    high: float
    start: float
    end: float
    log: bool = False

    @classmethod
    def of(cls, values: Sequence[float], start: float, end: float, *, log_from: float = math.inf) -> Axis:
        """Return the axis that holds all values, with some room; logarithmic from a ratio of `log_from`."""
        low, high = min(values), max(values)
        if low > 0 and high / low >= log_from:
            margin = (high / low) ** _ROOM
            return cls(low / margin, high * margin, start, end, True)
        # What hardly changes is drawn as a line that hardly rises.
        margin = max(_ROOM * (high - low), (_LEAST_SPAN * abs(high) - (high - low)) / 2) or 1.0
        return cls(low - margin, high + margin, start, end)

    def place(self, value: float) -> float:
        """Return the place of a value."""
        if self.log:
            part = math.log(value / self.low) / math.log(self.high / self.low)
        else:
            part = (value - self.low) / (self.high - self.low)
        return round(self.start + part * (self.end - self.start), 2)

    def ticks(self, count: int = 5) -> list[float]:
        """Return about `count` round values inside the axis."""
        return self._log_ticks(count) if self.log else linear_ticks(self.low, self.high, count)

    def _log_ticks(self, count: int) -> list[float]:
        first, last = math.floor(math.log10(self.low)), math.ceil(math.log10(self.high))
        decades = last - first
        factors = (1, 2, 5) if decades <= 2 else (1, 3) if decades <= 3 else (1,)
        every = max(1, -(-decades // (2 * count)))
        values = [
            factor * 10.0**power
            for power in range(first, last + 1)
            if (power - first) % every == 0
            for factor in factors
        ]
        inside = [value for value in values if self.low <= value <= self.high]
        return inside if len(inside) > 1 else linear_ticks(self.low, self.high, count)


def linear_ticks(low: float, high: float, count: int = 5) -> list[float]:
    """Return about `count` multiples of 1, 2, 2.5 or 5 times a power of ten between two values.

    >>> linear_ticks(0.0, 1.04)
    [0.0, 0.25, 0.5, 0.75, 1.0]
    """
    span = high - low
    if not span > 0:
        return [low]
    rough = span / count
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(factor * power for factor in _STEPS if factor * power >= rough * 0.999)
    first = math.ceil(low / step - 1e-9)
    return [round(k * step, 12) for k in range(first, math.floor(high / step + 1e-9) + 1)]


def tick_text(value: float) -> str:
    """Return a tick's label.

    >>> [tick_text(v) for v in (0.0, 0.25, 1500.0, 3e-05, 2e7)]
    ['0', '0.25', '1,500', '3e-05', '2e+07']
    """
    size = abs(value)
    if size and (size >= 1e6 or size < 1e-3):
        return f"{value:.3g}"
    return f"{value:,.10g}" if size < 1 else f"{round(value, 6):,.10g}"


@dataclass(frozen=True)
class Bar:
    """A bar's place and what it counts."""

    x: float
    y: float
    width: float
    height: float
    count: int
    low: float
    high: float
    text: str


@dataclass(frozen=True)
class Histogram:
    """One column's distribution over the scans that have it."""

    column: str
    label: str
    unit: str
    bars: tuple[Bar, ...]
    ticks: tuple[tuple[float, str], ...]
    count_ticks: tuple[tuple[float, str], ...]
    median_at: float
    summary: str
    missing: int

    width, height = 300, 170
    left, right, top, bottom = 34, 288, 18, 140


def histogram(column: str, values: Sequence[float | None]) -> Histogram | None:
    """Return the distribution of a column's known values; None when fewer than two are known."""
    factor = 100.0 if is_share(column) else 1.0
    known = np.array([factor * value for value in values if value is not None])
    if len(known) < 2:
        return None
    edges, log = _edges(known)
    counts, _ = np.histogram(known, edges)
    axis = Axis(float(edges[0]), float(edges[-1]), Histogram.left, Histogram.right, log)
    upward = Axis(0, float(counts.max()) or 1.0, Histogram.bottom, Histogram.top)
    unit = unit_of(column)
    whole = _is_whole(known)
    bars = [
        _bar(axis, upward, float(low), float(high), int(count), unit, whole)
        for low, high, count in zip(edges[:-1], edges[1:], counts, strict=True)
    ]
    low, median, high = (float(v) for v in np.percentile(known, (5, 50, 95)))
    summary = f"median {number_text(median)}, 90 % within {number_text(low)} … {number_text(high)}"
    if known.min() == known.max():
        summary = f"all {number_text(median)}"
    ticks = [value for value in axis.ticks(4) if not whole or value == int(value)]
    return Histogram(
        column,
        label_of(column),
        unit,
        tuple(bars),
        tuple((axis.place(value), tick_text(value)) for value in ticks),
        tuple((upward.place(v), tick_text(v)) for v in upward.ticks(3) if v == int(v)),
        axis.place(median),
        summary,
        len(values) - len(known),
    )


def _is_whole(known: np.ndarray) -> bool:
    return bool((known == np.round(known)).all() and np.ptp(known) < _MOST_WHOLE)


def _edges(known: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return the borders of the bins, and whether they are logarithmic."""
    low, high = float(known.min()), float(known.max())
    if _is_whole(known):
        return np.arange(low - 0.5, high + 1), False
    bins = int(np.clip(2 * np.sqrt(len(known)), 5, _BINS))
    if low > 0 and high / low >= _LOG_VALUES:
        return np.geomspace(low, high, bins + 1), True
    if high - low <= 1e-9 * max(abs(high), 1e-300):
        half = 0.05 * abs(high) or 0.5
        return np.linspace(low - half, high + half, 4), False
    return np.linspace(low, high, bins + 1), False


def _bar(axis: Axis, upward: Axis, low: float, high: float, count: int, unit: str, whole: bool) -> Bar:
    left, right, top = axis.place(low), axis.place(high), upward.place(count)
    space = f" {unit}" if unit else ""
    where = number_text(round((low + high) / 2)) if whole else f"{number_text(low)} … {number_text(high)}"
    scans = "scan" if count == 1 else "scans"
    gap = 1.5 if right - left > 5 else 0.5
    return Bar(
        round(left + gap / 2, 2),
        top,
        round(right - left - gap, 2),
        round(Histogram.bottom - top, 2),
        count,
        low,
        high,
        f"{where}{space}: {count} {scans}",
    )


@dataclass(frozen=True)
class StageChart:
    """The points of one stage and their places; of a single row there is the summary alone."""

    stage: str
    unit: str
    rows: tuple[TraceRow, ...]
    summary: str
    time: Axis
    error: Axis

    @property
    def drawn(self) -> bool:
        """Whether there is more than a point to draw."""
        return len(self.rows) > 1

    @property
    def places(self) -> list[tuple[float, float]]:
        """Places of the rows in the drawing."""
        return [(self.time.place(row.elapsed_s), self.error.place(row.error)) for row in self.rows]

    @property
    def line(self) -> str:
        """The points as an SVG polyline takes them."""
        return " ".join(f"{x:g},{y:g}" for x, y in self.places)

    @property
    def points_json(self) -> str:
        """Places and texts for the pointer, as JSON."""
        texts = [
            f"{number_text(row.error, 4)} {self.unit} · {number_text(row.elapsed_s, 4)} s · "
            f"{number_text(row.cpu_s, 4)} s CPU · evaluation {row.evaluations:,}"
            for row in self.rows
        ]
        return json.dumps([[x, y, text] for (x, y), text in zip(self.places, texts, strict=True)])

    def ticks(self, which: str) -> list[tuple[float, str]]:
        """Return place and label of the ticks of "time" or "error"."""
        axis = self.time if which == "time" else self.error
        return [(axis.place(value), tick_text(value)) for value in axis.ticks(4)]

    width, height = 360, 230
    left, right, top, bottom = 58, 348, 12, 190


def read_trace(file: Path) -> list[TraceRow]:
    """Return the finite rows of a `trace.csv`; Scan2AlbedoError names file and line that cannot be read."""
    if file.exists() and not file.is_file():
        raise Scan2AlbedoError(f"{file}: is a folder, a pipe or a device, not a file")
    try:
        with file.open(encoding="utf-8", newline="") as opened:
            lines = list(csv.DictReader(opened))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise Scan2AlbedoError(f"{file}: cannot be read: {error}") from error
    rows = []
    for k, line in enumerate(lines, 2):
        try:
            row = TraceRow(
                line["stage"],
                float(line["elapsed_s"]),
                float(line["cpu_s"]),
                int(line["evaluations"]),
                float(line["error"]),
                line["unit"],
            )
        except (KeyError, TypeError, ValueError) as error:
            raise Scan2AlbedoError(f"{file}: line {k} is no row of a trace ({error})") from error
        if math.isfinite(row.error) and math.isfinite(row.elapsed_s):
            rows.append(row)
    return rows


def stage_charts(rows: Sequence[TraceRow]) -> list[StageChart]:
    """Return a chart for each stage, in the order in which they ran."""
    stages: dict[str, list[TraceRow]] = {}
    for row in rows:
        stages.setdefault(row.stage, []).append(row)
    return [_chart(stage, found) for stage, found in stages.items()]


def _chart(stage: str, rows: list[TraceRow]) -> StageChart:
    first, last = rows[0], rows[-1]
    summary = f"{number_text(last.error)} {last.unit} after {last.evaluations:,} evaluations"
    if len(rows) > 1:
        summary = f"{number_text(first.error)} → {summary}"
    step = -(-len(rows) // MOST_POINTS)
    shown = rows if step == 1 else [*rows[:-1:step], last]
    return StageChart(
        stage,
        last.unit,
        tuple(shown),
        summary,
        Axis.of([row.elapsed_s for row in shown], StageChart.left, StageChart.right, log_from=_LOG_TIME),
        Axis.of([row.error for row in shown], StageChart.bottom, StageChart.top, log_from=_LOG_ERROR),
    )
