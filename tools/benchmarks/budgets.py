"""Do stages keep a budget in seconds, and have they done by then what they had done without one?

A stage runs without limit, and its trace tells when the logarithm of its error had gained 95 % of all that it
gained: t*, of the slowest of some runs. Run with t* seconds it should reach 90 % of what it reaches without,
and end then. The machine's other work shows in the wall clock, which budgets are counted by; so of some runs
the one that came farthest counts, and the overrun is given in CPU seconds: the part of the wall time beyond
the budget, times the run's own CPU time over its wall time.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from benchmarks.sweep import Cost, timed
from scan2albedo.core import ProgressCallback, TraceRow

TINY_S = (0.01, 0.1)
"""Budgets in which hardly anything can be done."""
_GAINED, _GAIN_OF_TRACE = 0.9, 0.95
_GRACE_S = 0.3
_FEWEST_ROWS = 3
_LEAST_ERROR = 1e-12
REPEATS = 3
_AS_GOOD = 1.01
"""Where an error cannot fall it may rise by this factor."""

Budgeted = Callable[[float | None, ProgressCallback | None], Any]
"""Runs a stage with a budget in seconds (None: no limit) and returns what it found."""


@dataclass(frozen=True)
class BudgetedStage:
    """A stage on one scene.

    Parameters
    ----------
    name : str
    unit : str
        Of the error.
    run : callable
        See `Budgeted`.
    error : callable
        From what the stage found to its error against the truth.
    start_error : float
        The error of what there is before the stage has done anything.
    """

    name: str
    unit: str
    run: Budgeted
    error: Callable[[Any], float]
    start_error: float


@dataclass(frozen=True)
class BudgetRow:
    """One stage with one budget.

    Parameters
    ----------
    stage, unit : str
    budget_s : float
    knee : bool
        Whether the budget is t*, read from the trace.
    wall_s, cpu_s : float
        What the run took.
    error, full_error, start_error : float
        Against the truth: with the budget, without one, before the stage.
    """

    stage: str
    unit: str
    budget_s: float
    knee: bool
    wall_s: float
    cpu_s: float
    error: float
    full_error: float
    start_error: float

    @property
    def share(self) -> float:
        """Part of the whole reduction of the error that was reached.

        Where there was none to reach 1 if no more than a hundredth was lost, else 0.
        """
        whole = self.start_error - self.full_error
        if whole > 0:
            return (self.start_error - self.error) / whole
        return float(self.error <= _AS_GOOD * self.start_error)

    @property
    def overrun_s(self) -> float:
        """CPU seconds of what ran beyond the budget."""
        return max(self.wall_s - self.budget_s, 0.0) * min(self.cpu_s / max(self.wall_s, 1e-9), 1.0)

    @property
    def kept(self) -> bool:
        """Whether the overrun is below a fifth or 0.3 s, and 90 % were reached where t* was given."""
        in_time = self.overrun_s < max(self.budget_s / 5, _GRACE_S)
        return in_time and (not self.knee or self.share >= _GAINED)

    def figures(self) -> dict[str, Any]:
        """Return all as plain numbers."""
        return {**asdict(self), "share": self.share, "overrun_s": self.overrun_s, "kept": self.kept}

    def text(self) -> str:
        """Return the row of the table."""
        name = f"{self.stage}, t*" if self.knee else self.stage
        return (
            f"{name:24}{self.budget_s:10.3f}{self.wall_s:9.3f}{self.cpu_s:9.3f}{self.overrun_s:10.3f}"
            f"{100 * self.share:9.1f} %{self.start_error:12.4g}{self.error:12.4g}{self.full_error:12.4g} "
            f"{self.unit:6}{'kept' if self.kept else 'NOT KEPT'}"
        )


def budget_table(rows: Sequence[BudgetRow]) -> str:
    """Return the rows as text."""
    head = (
        f"{'budgets kept':24}{'budget s':>10}{'wall s':>9}{'CPU s':>9}{'overrun':>10}{'reached':>11}"
        f"{'at start':>12}{'with it':>12}{'without':>12}"
    )
    return "\n".join([head, "-" * len(head), *(row.text() for row in rows)])


def time_of_gain(rows: Sequence[tuple[float, TraceRow]], share: float = _GAIN_OF_TRACE) -> float:
    """Return when the logarithm of a trace's last error measure had gained `share` of all that it gained.

    Parameters
    ----------
    rows : sequence of (float, TraceRow)
        Seconds since the stage began, and the row. Errors of another stage or unit are another measure; the
        last one with three rows or more counts, or the last one at all.
    share : float

    Returns
    -------
    float
        inf without rows of finite errors.
    """
    measures: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for seconds, row in rows:
        if math.isfinite(row.error):
            measures.setdefault((row.stage, row.unit), []).append((seconds, row.error))
    if not measures:
        return math.inf
    every = list(measures.values())
    chosen = next((points for points in reversed(every) if len(points) >= _FEWEST_ROWS), every[-1])
    heights = [math.log(max(error, _LEAST_ERROR)) for _, error in chosen]
    enough = heights[0] - share * (heights[0] - min(heights))
    return next(s for (s, _), height in zip(chosen, heights, strict=True) if height <= enough)


def checked_budgets(
    stage: BudgetedStage, budgets_s: Sequence[float] = TINY_S, repeats: int = REPEATS
) -> list[BudgetRow]:
    """Return the rows of one stage: with t*, and with the budgets given; each the best of some runs."""
    full_error, knee_s = _unlimited(stage, repeats)
    found = []
    for budget in (knee_s, *budgets_s):
        if not math.isfinite(budget):
            continue
        error, cost = _farthest(stage, budget, repeats)
        found.append(
            BudgetRow(
                stage.name,
                stage.unit,
                budget,
                budget == knee_s,
                cost.wall_s,
                cost.cpu_s,
                error,
                full_error,
                stage.start_error,
            )
        )
    return found


def _unlimited(stage: BudgetedStage, repeats: int) -> tuple[float, float]:
    """Return the error without a limit, and t* of the slowest run: a quicker one's would come too soon."""
    found, knees = stage.run(None, None), []
    for _ in range(repeats):
        log: list[tuple[float, TraceRow]] = []
        begin = time.perf_counter()
        found = stage.run(None, lambda row: log.append((time.perf_counter() - begin, row)))  # noqa: B023
        knees.append(time_of_gain(log))
    return stage.error(found), max(knees)


def _farthest(stage: BudgetedStage, budget_s: float, repeats: int) -> tuple[float, Cost]:
    """Return error and cost of the run that came farthest: what others' work delays says nothing of ours."""
    runs = []
    for _ in range(repeats):
        result, cost = timed(lambda: stage.run(budget_s, None))
        runs.append((stage.error(result), cost))
    return min(runs, key=lambda run: (run[0], run[1].wall_s))
