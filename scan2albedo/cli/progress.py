"""Progress on stderr: a live line on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import TYPE_CHECKING, Self

from scan2albedo.core import TraceRow
from scan2albedo.errors import printable

if TYPE_CHECKING:
    from rich.progress import ProgressColumn

    from scan2albedo.batch import BatchProgress

PLAIN_INTERVAL_S = 2.0
"""Shortest time between two plain lines of one thing."""


class StderrLines:
    """A bar on stderr where that is a terminal, and lines that stay; use as a context manager."""

    def __init__(self, *columns: ProgressColumn) -> None:
        from rich.console import Console
        from rich.progress import Progress

        self._console = Console(stderr=True)
        self._last_plain = 0.0
        self._bar: Progress | None = None
        if sys.stderr.isatty():
            self._bar = Progress(*columns, console=self._console, transient=True)

    def __enter__(self) -> Self:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def say(self, line: str) -> None:
        """Print a line that stays, without anything in it that a terminal would obey."""
        self._console.print(printable(line), highlight=False, markup=False, soft_wrap=True)


class ProgressLines(StderrLines):
    """Shows the trace rows of a running scan; use as a context manager."""

    def __init__(self, name: str) -> None:
        from rich.progress import BarColumn, SpinnerColumn, TextColumn, TimeElapsedColumn

        super().__init__(
            SpinnerColumn(),
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[error]}"),
        )
        self._name, self._stage = printable(name), ""
        if self._bar is not None:
            self._task = self._bar.add_task(self._name, total=None, error="")

    def update(self, row: TraceRow) -> None:
        """Show one trace row."""
        if self._bar is not None:
            error = f"{row.error:.4g} {row.unit} after {row.evaluations} evaluations"
            self._bar.update(self._task, description=f"{self._name}: {row.stage}", error=error)
            return
        now = time.monotonic()
        if row.stage != self._stage or now - self._last_plain > PLAIN_INTERVAL_S:
            self._stage, self._last_plain = row.stage, now
            self.say(f"{self._name}: {row.stage} ... {row.error:.4g} {row.unit}")

    def count(self, stage: str, done: int, total: int) -> None:
        """Show how many things of a stage are done."""
        if self._bar is not None:
            text = f"{done} of {total}"
            self._bar.update(
                self._task,
                description=f"{self._name}: {stage}",
                completed=done,
                total=total,
                error=text,
            )
            return
        now = time.monotonic()
        if stage != self._stage:
            self._stage, self._last_plain = stage, now
        elif now - self._last_plain > PLAIN_INTERVAL_S:
            self._last_plain = now
            self.say(f"{self._name}: {stage} ... {done} of {total}")


class BatchLines(StderrLines):
    """Shows how far a batch is; use as a context manager."""

    def __init__(self) -> None:
        from rich.progress import BarColumn, TextColumn, TimeElapsedColumn

        super().__init__(
            TextColumn("batch"), BarColumn(), TextColumn("{task.fields[state]}"), TimeElapsedColumn()
        )
        if self._bar is not None:
            self._task = self._bar.add_task("batch", total=None, state="starting workers")

    def update(self, progress: BatchProgress) -> None:
        """Show a scan that has ended, or a note."""
        if progress.note:
            self.say(f"batch: {progress.note}")
        last = progress.last
        if self._bar is not None:
            if last is not None and last.status == "failed":
                self.say(f"{last.name}: failed: {last.reason}")
            ended = progress.done + progress.failed
            self._bar.update(self._task, total=progress.total, completed=ended, state=_state(progress))
        elif last is not None and progress.left and time.monotonic() - self._last_plain > PLAIN_INTERVAL_S:
            self._last_plain = time.monotonic()
            self.say(f"batch: {_state(progress)}")


def _state(progress: BatchProgress) -> str:
    parts = [f"{progress.done} of {progress.total} done"]
    if progress.failed:
        parts.append(f"{progress.failed} failed")
    if progress.scans_per_hour is not None:
        parts.append(f"{progress.scans_per_hour:.0f} scans/h")
    if progress.left_s and progress.left:
        parts.append(f"{_duration(progress.left_s)} left")
    return ", ".join(parts)


def _duration(seconds: float) -> str:
    """Return seconds as a person says them.

    >>> _duration(59), _duration(600), _duration(9000)
    ('59 s', '10 min', '2.5 h')
    """
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
