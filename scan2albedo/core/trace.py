"""Error against run time: the rows every iterative stage records."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_PANELS_A_ROW = 6
_LOG_FROM = 5.0
"""Ratio of errors from which their axis is logarithmic: within a decade it has hardly a number on it."""
_SHORT_S = 0.1
"""Stages that take less are drawn in milliseconds."""
_TICKS = 5
"""Intervals between labels of an axis, at most: more overlap."""


@dataclass(frozen=True)
class TraceRow:
    """One point of the error-against-run-time curve of a stage."""

    stage: str
    """That recorded the row."""
    elapsed_s: float
    cpu_s: float
    """`elapsed_s` and `cpu_s` are wall-clock and CPU seconds since the stage began."""
    evaluations: int
    """Spent by then."""
    error: float
    """In `unit`."""
    unit: str
    """Of the error."""


@dataclass(frozen=True)
class Trace:
    """Rows (stage, elapsed_s, cpu_s, evaluations, error, unit) in the order they were recorded.

    Times and evaluations count from the start of each row's own stage.
    """

    rows: tuple[TraceRow, ...] = ()
    """In the order they were recorded."""

    def __iter__(self) -> Iterator[TraceRow]:
        return iter(self.rows)

    def __len__(self) -> int:
        return len(self.rows)

    def __add__(self, other: Trace) -> Trace:
        return Trace(self.rows + other.rows)

    @property
    def stages(self) -> tuple[str, ...]:
        """Stage names in order of first appearance."""
        return tuple(dict.fromkeys(row.stage for row in self.rows))

    def of_stage(self, stage: str) -> Trace:
        """Return the rows of one stage."""
        return Trace(tuple(row for row in self.rows if row.stage == stage))

    def runs(self) -> tuple[Trace, ...]:
        """Return the rows of each run, cut where time or evaluations go back: a stage began anew there."""
        runs: list[list[TraceRow]] = []
        for row in self.rows:
            last = runs[-1][-1] if runs else None
            if last is None or row.elapsed_s < last.elapsed_s or row.evaluations < last.evaluations:
                runs.append([])
            runs[-1].append(row)
        return tuple(Trace(tuple(run)) for run in runs)

    def to_csv(self, path: str | Path | None = None) -> str:
        """Return the trace as CSV text and, when `path` is given, write it there too."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow([f.name for f in fields(TraceRow)])
        writer.writerows(astuple(row) for row in self.rows)
        if path is not None:
            Path(path).write_text(text.getvalue(), encoding="utf-8")
        return text.getvalue()

    def plot(self) -> Figure:
        """Draw error against elapsed seconds, one panel a stage, and return the matplotlib figure.

        A stage that ran twice has two curves, each over the time since its own run began.
        """
        from matplotlib.figure import Figure

        stages = self.stages or ("nothing recorded",)
        columns = min(len(stages), _PANELS_A_ROW)
        rows_of_panels = -(-len(stages) // columns)
        figure = Figure(figsize=(4.2 * columns, 3.2 * rows_of_panels), layout="constrained")
        axes = figure.subplots(rows_of_panels, columns, squeeze=False).ravel()
        for unused in axes[len(stages) :]:
            unused.set_axis_off()
        for axis, stage in zip(axes, stages, strict=False):
            axis.set_title(stage)
            _draw(axis, self.of_stage(stage))
        return figure


def _draw(axis: Axes, trace: Trace) -> None:
    """Draw one stage's error against its run time; a single error is told in words, for it makes no curve."""
    from matplotlib.ticker import MaxNLocator

    rows, runs = trace.rows, trace.runs()
    errors = [row.error for row in rows]
    if len(set(errors)) < 2:
        told = "nothing recorded"
        if rows:
            done = "evaluation" if rows[-1].evaluations == 1 else "evaluations"
            told = (
                f"{errors[0]:.3g} {rows[0].unit}\n{rows[-1].evaluations} {done}, {_span(rows[-1].elapsed_s)}"
            )
        axis.set_axis_off()
        axis.text(0.5, 0.5, told, ha="center", va="center", transform=axis.transAxes)
        return
    short = max(row.elapsed_s for row in rows) < _SHORT_S
    for number, run in enumerate(runs, start=1):
        times, reached = [row.elapsed_s * (1000 if short else 1) for row in run], [row.error for row in run]
        axis.plot(times, reached, marker=".", linewidth=1, label=f"run {number}")
    if len(runs) > 1:
        axis.legend(fontsize=8)
    axis.set_xlabel("elapsed [ms]" if short else "elapsed [s]")
    axis.set_ylabel(f"error [{rows[0].unit}]")
    axis.xaxis.set_major_locator(MaxNLocator(_TICKS))
    if min(errors) > 0 and max(errors) > _LOG_FROM * min(errors):
        axis.set_yscale("log")
    else:
        axis.yaxis.set_major_locator(MaxNLocator(_TICKS))
    axis.ticklabel_format(axis="x", useOffset=False, style="plain")
    axis.grid(True, which="both", alpha=0.3)


def _span(seconds: float) -> str:
    return f"{1000 * seconds:.3g} ms" if seconds < _SHORT_S else f"{seconds:.3g} s"
