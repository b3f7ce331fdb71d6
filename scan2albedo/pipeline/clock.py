"""The clock of one run: what is left of its budget, and what each part that is still to come takes of it."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

from scan2albedo.core import Budget


class Clock:
    """Times the stages of one run, and shares what is left of its budget among their searches.

    `due_s` are seconds, by name, that are not to be spent elsewhere: the cost of each stage that is still to
    come, and of files that are still to be written. `spent_s` were spent before the clock was made.
    """

    def __init__(self, budget: Budget, spent_s: float = 0.0) -> None:
        self.budget = budget
        self.timings_s = dict[str, float]()
        self.due_s = dict[str, float]()
        self._start = time.perf_counter() - spent_s

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Take the time of a stage, which is then no longer due."""
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.timings_s[stage] = time.perf_counter() - begin
            self.due_s.pop(stage, None)

    def left_s(self) -> float:
        """Return the seconds that nothing needs yet; below 0 where there are too few."""
        if self.budget.seconds is None:
            return float("inf")
        spent = time.perf_counter() - self._start
        return self.budget.seconds - spent - sum(self.due_s.values())

    def share(self, part: float) -> Budget:
        """Return a part of what is left, for a search."""
        if self.budget.seconds is None:
            return self.budget
        return replace(self.budget, seconds=max(self.left_s() * part, 1e-3))
