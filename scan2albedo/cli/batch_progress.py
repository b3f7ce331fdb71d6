"""A batch's progress on stderr: a live bar on a terminal, a plain line now and then elsewhere."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from scan2albedo.cli.progress import PLAIN_INTERVAL_S, StderrLines

if TYPE_CHECKING:
    from scan2albedo.batch import BatchProgress


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
