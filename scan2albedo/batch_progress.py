"""A batch's progress on stderr: a live bar on a terminal, a plain line now and then elsewhere."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import Progress

    from scan2albedo.batch import BatchProgress

PLAIN_INTERVAL_S = 2.0
"""Shortest time between two plain lines."""


class BatchLines:
    """Shows how far a batch is; use as a context manager."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        self._console = Console(stderr=True)
        self._last_plain = 0.0
        self._bar: Progress | None = None
        if sys.stderr.isatty():
            self._bar = Progress(
                TextColumn("batch"),
                BarColumn(),
                TextColumn("{task.fields[state]}"),
                TimeElapsedColumn(),
                console=self._console,
                transient=True,
            )
            self._task = self._bar.add_task("batch", total=None, state="starting workers")

    def __enter__(self) -> BatchLines:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

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

    def say(self, line: str) -> None:
        """Print a line that stays."""
        self._console.print(line, highlight=False, markup=False, soft_wrap=True)


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
