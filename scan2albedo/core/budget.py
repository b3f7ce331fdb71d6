"""Budgets in seconds or evaluations, and the meter that spends them and writes the trace."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from numbers import Integral, Real

from scan2albedo.core.trace import Trace, TraceRow


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
    def of(cls, value: Budget | float | None) -> Budget:
        """Return `value` as a Budget: a number means seconds, None means no limit."""
        return value if isinstance(value, Budget) else cls(seconds=value)


def checked_seed(seed: int) -> int:
    """Return a random seed, 0 or more; ValueError for others (None would give another answer every time)."""
    if isinstance(seed, Integral) and seed >= 0:
        return int(seed)
    raise ValueError(f"seed is {seed!r}, expected a whole number, 0 or more")


ProgressCallback = Callable[[TraceRow], None]


@dataclass
class Meter:
    """Clock, evaluation count and trace of one running stage."""

    stage: str
    """Name written into the trace rows."""
    unit: str
    """Unit of the errors recorded, for example "mm"."""
    budget: Budget = field(default_factory=Budget)
    """Limits that `exhausted` checks."""
    on_progress: ProgressCallback | None = None
    """Called with every recorded `TraceRow`."""
    evaluations: int = 0
    rows: list[TraceRow] = field(default_factory=list)
    """`evaluations` spent and `rows` recorded so far."""
    _wall_start: float = field(default_factory=time.perf_counter)
    _cpu_start: float = field(default_factory=time.process_time)

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
