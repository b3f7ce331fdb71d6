"""Error against run time: the rows every iterative stage records."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class TraceRow:
    """One point of the error-against-run-time curve of a `stage`: its `error` in `unit`."""

    stage: str
    elapsed_s: float
    cpu_s: float
    evaluations: int
    """`elapsed_s`, `cpu_s`, `evaluations`: wall-clock and CPU seconds and evaluations since it began."""
    error: float
    unit: str


@dataclass(frozen=True)
class Trace:
    """The `rows` of one or several stages in the order they were recorded."""

    rows: tuple[TraceRow, ...] = ()

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
        """Draw error against elapsed seconds, a panel a stage, a curve a run; return the figure."""
        from matplotlib.figure import Figure
        from matplotlib.ticker import MaxNLocator

        stages = self.stages or ("nothing recorded",)
        columns = min(len(stages), 6)
        panel_rows = -(-len(stages) // columns)
        figure = Figure(figsize=(4.2 * columns, 3.2 * panel_rows), layout="constrained")
        for number, stage in enumerate(stages, start=1):
            axis = figure.add_subplot(panel_rows, columns, number, title=stage)
            found = self.of_stage(stage)
            errors = [row.error for row in found]
            if len(set(errors)) < 2:  # no curve: the error is written
                axis.set_axis_off()
                for last in found.rows[-1:]:
                    spent = f"{last.evaluations} evaluations, {last.elapsed_s:.3g} s"
                    text = f"{last.error:.3g} {last.unit}\n{spent}"
                    axis.text(0.5, 0.5, text, ha="center", va="center", transform=axis.transAxes)
                continue
            runs = found.runs()
            for count, run in enumerate(runs, start=1):
                times, reached = [row.elapsed_s for row in run], [row.error for row in run]
                axis.plot(times, reached, marker=".", linewidth=1, label=f"run {count}")
            if len(runs) > 1:
                axis.legend(fontsize=8)
            axis.set(xlabel="elapsed [s]", ylabel=f"error [{found.rows[0].unit}]")
            # Within half a decade an axis in logarithms has hardly a number on it.
            if 0 < 5 * min(errors) < max(errors):
                axis.set_yscale("log")
            axis.xaxis.set_major_locator(MaxNLocator(3))
            axis.ticklabel_format(axis="x", useOffset=False, style="plain")
            axis.grid(True, which="both", alpha=0.3)
        return figure
