"""Error against time: a chart of each stage of a trace."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from scan2albedo.core import TraceRow
from scan2albedo.errors import Scan2AlbedoError
from scan2albedo.report.html.axes import Axis, tick_text
from scan2albedo.report.html.texts import number_text

WIDTH, HEIGHT = 360, 230
_LEFT, _RIGHT, _TOP, _BOTTOM = 58, 12, 12, 40
_LOG_ERROR, _LOG_TIME = 5.0, 50.0
"""Ratios of greatest to least from which an axis is logarithmic."""
MOST_POINTS = 400
"""Points that a chart of 300 pixels can show; of more, every n-th."""


@dataclass(frozen=True)
class StageChart:
    """The points of one stage and where they lie; a stage of a single row is told in words alone."""

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
        """Where the rows lie in the drawing."""
        return [(self.time.place(row.elapsed_s), self.error.place(row.error)) for row in self.rows]

    @property
    def line(self) -> str:
        """The points as an SVG polyline takes them."""
        return " ".join(f"{x:g},{y:g}" for x, y in self.places)

    @property
    def points_json(self) -> str:
        """For the pointer: place and what to say, as JSON."""
        said = [
            f"{number_text(row.error, 4)} {self.unit} · {number_text(row.elapsed_s, 4)} s · "
            f"{number_text(row.cpu_s, 4)} s CPU · evaluation {row.evaluations:,}"
            for row in self.rows
        ]
        return json.dumps([[x, y, text] for (x, y), text in zip(self.places, said, strict=True)])

    def ticks(self, which: str) -> list[tuple[float, str]]:
        """Return place and label of the ticks of "time" or "error"."""
        axis = self.time if which == "time" else self.error
        return [(axis.place(value), tick_text(value)) for value in axis.ticks(4)]

    width, height, left, top = WIDTH, HEIGHT, _LEFT, _TOP
    right, bottom = WIDTH - _RIGHT, HEIGHT - _BOTTOM


def read_trace(file: Path) -> list[TraceRow]:
    """Return the rows of a `trace.csv`; those without a finite error are left out.

    Raises
    ------
    Scan2AlbedoError
        When it cannot be read; the message names the file and the line.
    """
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
        Axis.of([row.elapsed_s for row in shown], _LEFT, WIDTH - _RIGHT, log_from=_LOG_TIME),
        Axis.of([row.error for row in shown], HEIGHT - _BOTTOM, _TOP, log_from=_LOG_ERROR),
    )
