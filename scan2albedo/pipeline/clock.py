"""The clock of one run: what is left of its budget, and what each part that is still to come takes of it."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

from scan2albedo.core import Budget

SHARES = {"register": 0.25, "fit": 0.4, "linear_model": 0.3, "albedo": 0.9}
"""Share of the seconds still left for searching that each search may take."""
OUTPUTS_SHARE = 0.3
"""Share of the whole budget that is kept at most for what may be left out: the face itself comes first."""


class Clock:
    """Times the stages of one run, and shares what is left of its budget among them.

    Beside the seconds that were spent, `spent_s` of them before it was made, it knows those that are not to
    be spent elsewhere: `due_s` of each stage that no run leaves out, `kept_s` of outputs that follow the last
    search, and `files_s` of the files of outputs that were made.
    """

    def __init__(self, budget: Budget, spent_s: float = 0.0) -> None:
        self.budget = budget
        self.timings_s = dict[str, float]()
        self.due_s = dict[str, float]()
        self.kept_s = 0.0
        self.files_s = 0.0
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
        return self.budget.seconds - spent - self.files_s - sum(self.due_s.values())

    def keep(self, outputs_s: float) -> None:
        """Keep seconds for outputs, at most a share of the budget."""
        self.kept_s = min(outputs_s, OUTPUTS_SHARE * (self.budget.seconds or 0.0))

    def share(self, search: str) -> Budget:
        """Return a search's part of what is left."""
        if self.budget.seconds is None:
            return self.budget
        return replace(self.budget, seconds=max((self.left_s() - self.kept_s) * SHARES[search], 1e-3))
