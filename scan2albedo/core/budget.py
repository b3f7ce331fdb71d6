"""Budgets in seconds or evaluations, the meter that spends them, and the trace of error against run time."""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Callable, Iterator
from dataclasses import astuple, dataclass, fields
from numbers import Integral, Real
from pathlib import Path
from typing import TYPE_CHECKING

from scan2albedo.core.arrays import Texts

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
    def stages(self) -> Texts:
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
        width_in = 7 * len(stages) / 2
        figure = Figure(figsize=(width_in, 3), dpi=110)
        axes = figure.subplots(1, len(stages), squeeze=False)[0]
        figure.subplots_adjust(0.8 / width_in, 0.2, 0.99, 0.9, 0.3)
        for axis, stage in zip(axes, stages, strict=True):
            axis.set_title(stage)
            found = self.of_stage(stage)
            errors = [row.error for row in found]
            runs = found.runs()
            for count, run in enumerate(runs, start=1):
                times, reached = [row.elapsed_s for row in run], [row.error for row in run]
                axis.plot(times, reached, marker=".", linewidth=1, label=f"run {count}")
                axis.set(xlabel="elapsed [s]", ylabel=f"error [{run.rows[0].unit}]")
            if len(runs) > 1:
                axis.legend(fontsize=8)
            # Within half a decade an axis in logarithms has hardly a number on it.
            if errors and 0 < 5 * min(errors) < max(errors):
                axis.set_yscale("log")
            axis.xaxis.set_major_locator(MaxNLocator(3))
            axis.ticklabel_format(axis="x", useOffset=False, style="plain")
            axis.grid(True, which="both", alpha=0.3)
        return figure


@dataclass(frozen=True)
class Budget:
    """How much an iterative stage may spend; ``None`` means without limit."""

    seconds: float | None = None
    """Wall-clock seconds, > 0."""
    evaluations: int | None = None
    """Objective evaluations (or iterations, where a stage counts those), >= 1. Only a budget in evaluations
    makes results reproducible bit by bit."""

    def __post_init__(self) -> None:
        if self.seconds is not None and not (isinstance(self.seconds, Real) and self.seconds > 0):
            raise ValueError(f"Budget.seconds must be a number > 0, got {self.seconds!r}")
        count = self.evaluations
        if count is not None and not (isinstance(count, Integral) and count >= 1):
            raise ValueError(f"Budget.evaluations must be a whole number >= 1, got {self.evaluations!r}")

    @classmethod
    def of(cls, value: BudgetLike) -> Budget:
        """Return `value` as a Budget: a number means seconds, None means no limit."""
        return value if isinstance(value, Budget) else cls(seconds=value)


def checked_seed(seed: int) -> int:
    """Return a random seed, 0 or more; ValueError for others (None would give another answer every time)."""
    if isinstance(seed, Integral) and seed >= 0:
        return int(seed)
    raise ValueError(f"seed is {seed!r}, expected a whole number, 0 or more")


ProgressCallback = Callable[[TraceRow], None]

BudgetLike = Budget | float | None
"""A budget as callers give it: a number means seconds, None means no limit."""
OnProgress = ProgressCallback | None
"""What is called with every row of a trace as it is recorded, if anything."""


class Meter:
    """Clock, evaluation count and trace of one running stage.

    `stage` is the name in the rows of the trace, `unit` that of the errors recorded, for example "mm". The
    `evaluations` spent and the `rows` recorded so far begin at none.
    """

    def __init__(
        self, stage: str, unit: str, budget: BudgetLike = None, on_progress: OnProgress = None
    ) -> None:
        self.stage = stage
        self.unit = unit
        self.on_progress = on_progress
        self.budget = Budget.of(budget)
        self.evaluations = 0
        self.rows = list[TraceRow]()
        self._wall_start = time.perf_counter()
        self._cpu_start = time.process_time()

    @property
    def elapsed_s(self) -> float:
        """Wall-clock seconds since the stage began."""
        return time.perf_counter() - self._wall_start

    @property
    def exhausted(self) -> bool:
        """Whether the budget has ended."""
        evaluations = self.budget.evaluations
        return self.out_of_time or (evaluations is not None and self.evaluations >= evaluations)

    @property
    def out_of_time(self) -> bool:
        """Whether the budget's seconds have ended; work that counts as no evaluation may then be left out."""
        return self.budget.seconds is not None and self.elapsed_s >= self.budget.seconds

    def count(self, evaluations: int = 1) -> None:
        """Add to the evaluations spent."""
        self.evaluations += evaluations

    def record(self, error: float, stage: str | None = None) -> None:
        """Append a trace row with the error reached so far; `stage` names a part with a curve of its own."""
        cpu_s, name = time.process_time() - self._cpu_start, stage or self.stage
        row = TraceRow(name, self.elapsed_s, cpu_s, self.evaluations, float(error), self.unit)
        self.rows.append(row)
        if self.on_progress is not None:
            self.on_progress(row)

    def sub_meter(self, stage: str, unit: str) -> Meter:
        """Return a meter for a stage inside this one, with what is left of the budget; `merge` it after."""
        seconds, evaluations = self.budget.seconds, self.budget.evaluations
        left = Budget(
            None if seconds is None else max(seconds - self.elapsed_s, 1e-6),
            None if evaluations is None else max(evaluations - self.evaluations, 1),
        )
        return Meter(stage, unit, left, self.on_progress)

    def untraced(self) -> Meter:
        """Return a meter with what is left of the budget, whose rows, of other errors, are dropped."""
        return Meter(self.stage, self.unit, self.sub_meter(self.stage, self.unit).budget)

    def merge(self, finished: Meter) -> None:
        """Add the evaluations and rows of a finished `sub_meter`."""
        self.evaluations += finished.evaluations
        self.rows.extend(finished.rows)

    @property
    def trace(self) -> Trace:
        """The rows recorded so far."""
        return Trace(tuple(self.rows))
