"""Charts of the page, dicts that the template draws: axes, distributions, errors against time."""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from scan2albedo.core import TraceRow
from scan2albedo.errors import Scan2AlbedoError
from scan2albedo.io.csv_tables import read_text, table_rows
from scan2albedo.report.html.texts import is_share, label_of, number_text, unit_of

_ROOM = 0.04
"""Beyond the outermost values, in parts of their span."""


@dataclass(frozen=True)
class Axis:
    """Values from `low` to `high` along `start` to `end` in the drawing's unit."""

    low: float
    high: float
    start: float
    end: float
    log: bool = False

    @classmethod
    def around(cls, values: Sequence[float], start: float, end: float) -> Self:
        """Return the axis that holds all values, with some room; logarithmic from a decade on."""
        low, high = min(values), max(values)
        if low > 0 and high >= 10 * low:
            margin = (high / low) ** _ROOM
            return cls(low / margin, high * margin, start, end, True)
        # What hardly changes is drawn as a line that hardly rises.
        margin = _ROOM * max(high - low, _ROOM * abs(high)) or 1.0
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
        from matplotlib.ticker import MaxNLocator

        values: list[float] = []
        if self.log:
            first, last = math.floor(math.log10(self.low)), math.ceil(math.log10(self.high))
            decades = last - first
            factors = (1, 2, 5) if decades <= 2 else (1, 3) if decades <= 3 else (1,)
            powers = range(first, last + 1, max(1, -(-decades // (2 * count))))
            values = [factor * 10.0**power for power in powers for factor in factors]
        inside = [value for value in values if self.low <= value <= self.high]
        if len(inside) > 1:
            return inside
        locator = MaxNLocator(count, steps=[1, 2, 2.5, 5, 10])
        values = [round(float(value), 12) for value in locator.tick_values(self.low, self.high)]
        return [value for value in values if self.low <= value <= self.high] or [self.low]

    def labels(self, count: int, *, whole: bool = False) -> list[tuple[float, str]]:
        """Return place and label of `ticks`; of whole numbers alone where asked."""
        ticks = [value for value in self.ticks(count) if not whole or value == int(value)]
        return [(self.place(value), number_text(value, 6)) for value in ticks]


def histogram(column: str, values: Sequence[float | None]) -> dict[str, Any] | None:
    """Return the distribution of a column's known values; None when fewer than two are known."""
    factor = 100.0 if is_share(column) else 1.0
    known = np.array([factor * value for value in values if value is not None])
    if len(known) < 2:
        return None
    low, high = float(known.min()), float(known.max())
    # Bars by Sturges' rule; whole numbers of a smaller range get a bar each.
    bins, log = math.ceil(math.log2(len(known))) + 1, False
    whole = bool((known == np.round(known)).all() and high - low < 2 * bins)
    around = Axis.around((low, high), 0, 1)
    if whole:
        edges = np.arange(low - 0.5, high + 1)
    elif around.log:
        edges, log = np.geomspace(low, high, bins + 1), True
    elif low < high:
        edges = np.linspace(low, high, bins + 1)
    else:
        edges = np.linspace(around.low, around.high, 4)
    counts, _ = np.histogram(known, edges)
    drawing = {"width": 300, "height": 170, "left": 34, "right": 288, "top": 18, "bottom": 140}
    axis = Axis(float(edges[0]), float(edges[-1]), drawing["left"], drawing["right"], log)
    upward = Axis(0, float(counts.max()) or 1.0, drawing["bottom"], drawing["top"])
    unit = unit_of(column)
    bars = []
    for start, end, count in zip(edges[:-1].tolist(), edges[1:].tolist(), counts.tolist(), strict=True):
        left, right, top = axis.place(start), axis.place(end), upward.place(count)
        gap = 1.5 if right - left > 5 else 0.5
        where = number_text(round((start + end) / 2))
        if not whole:
            where = f"{number_text(start)} … {number_text(end)}"
        text = f"{where}{f' {unit}' if unit else ''}: {count} {'scan' if count == 1 else 'scans'}"
        place = {"x": round(left + gap / 2, 2), "y": top, "width": round(right - left - gap, 2)}
        bars.append({**place, "height": round(drawing["bottom"] - top, 2), "count": count, "text": text})
    p5, median, p95 = (float(v) for v in np.percentile(known, (5, 50, 95)))
    summary = f"median {number_text(median)}, 90 % within {number_text(p5)} … {number_text(p95)}"
    summary = f"all {number_text(median)}" if low == high else summary
    about = {"column": column, "label": label_of(column), "unit": unit, "missing": len(values) - len(known)}
    ticks = {"ticks": axis.labels(4, whole=whole), "count_ticks": upward.labels(3, whole=True)}
    return {**drawing, **about, **ticks, "bars": bars, "median_at": axis.place(median), "summary": summary}


def read_trace(file: Path) -> list[TraceRow]:
    """Return the finite rows of a `trace.csv`; Scan2AlbedoError names file and line that cannot be read."""
    text = read_text(file, what=str(file), advice="process the scan again", error=Scan2AlbedoError)
    (_, header), *lines = table_rows(text, file, Scan2AlbedoError) or [(1, [])]
    rows = []
    for k, cells in lines:
        line = dict(zip(header, cells, strict=False))
        try:
            spent = float(line["elapsed_s"]), float(line["cpu_s"]), int(line["evaluations"])
            row = TraceRow(line["stage"], *spent, float(line["error"]), line["unit"])
        except (KeyError, TypeError, ValueError) as error:
            raise Scan2AlbedoError(f"{file}: line {k} is not a row of a trace ({error})") from error
        if math.isfinite(row.error) and math.isfinite(row.elapsed_s):
            rows.append(row)
    return rows


def stage_charts(trace: Sequence[TraceRow]) -> list[dict[str, Any]]:
    """Return a chart for each stage, in the order in which they ran; of a single row only the summary."""
    charts = []
    for stage in dict.fromkeys(row.stage for row in trace):
        rows = [row for row in trace if row.stage == stage]
        first, last = rows[0], rows[-1]
        summary = f"{number_text(last.error)} {last.unit} after {last.evaluations:,} evaluations"
        if len(rows) > 1:
            summary = f"{number_text(first.error)} → {summary}"
        drawing = {"width": 360, "height": 230, "left": 58, "right": 348, "top": 12, "bottom": 190}
        step = -(-len(rows) // drawing["width"])  # a point for each pixel at most
        shown = rows if step == 1 else [*rows[:-1:step], last]
        times, errors = [row.elapsed_s for row in shown], [row.error for row in shown]
        time = Axis.around(times, drawing["left"], drawing["right"])
        error = Axis.around(errors, drawing["bottom"], drawing["top"])
        places = [(time.place(row.elapsed_s), error.place(row.error)) for row in shown]
        texts = [
            f"{number_text(row.error, 4)} {last.unit} · {number_text(row.elapsed_s, 4)} s · "
            f"{number_text(row.cpu_s, 4)} s CPU · evaluation {row.evaluations:,}"
            for row in shown
        ]
        about = {"stage": stage, "unit": last.unit, "rows": shown, "summary": summary}
        axes = {"time": time, "error": error, "time_ticks": time.labels(4), "error_ticks": error.labels(4)}
        line = " ".join(f"{x:g},{y:g}" for x, y in places)
        points = json.dumps([[x, y, text] for (x, y), text in zip(places, texts, strict=True)])
        charts.append({**drawing, **about, **axes, "places": places, "line": line, "points_json": points})
    return charts
