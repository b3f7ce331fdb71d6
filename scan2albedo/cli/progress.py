"""Progress on stderr: a live line on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING, Any, Self

from scan2albedo.core import TraceRow
from scan2albedo.errors import printable

if TYPE_CHECKING:
    from scan2albedo.batch import BatchProgress


class ProgressLines:
    """A bar on stderr where that is a terminal, and lines that stay; use as a context manager."""

    def __init__(self, name: str) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

        self._console = Console(stderr=True)
        self._name = printable(name)
        self._stage = ""
        self._last_plain = 0.0
        self._bar: Progress | None = None
        if sys.stderr.isatty():
            columns = (
                SpinnerColumn(),
                TextColumn("{task.description}", markup=False),
                BarColumn(),
                TimeElapsedColumn(),
                TextColumn("{task.fields[state]}"),
            )
            self._bar = Progress(*columns, console=self._console, transient=True)
            self._task = self._bar.add_task(self._name, total=None, state="")

    def __enter__(self) -> Self:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(self, *error: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def say(self, line: str) -> None:
        """Print a line that stays, without anything in it that a terminal would obey."""
        self._console.print(printable(line), highlight=False, markup=False, soft_wrap=True)

    def update(self, row: TraceRow) -> None:
        """Show one trace row."""
        error = f"{row.error:.4g} {row.unit}"
        new = row.stage != self._stage
        self._show(row.stage, f"{error} after {row.evaluations} evaluations", error, new)

    def count(self, stage: str, done: int, total: int) -> None:
        """Show how many things of a stage are done."""
        if stage != self._stage:
            self._stage, self._last_plain = stage, time.monotonic()
        self._show(stage, f"{done} of {total}", completed=done, total=total)

    def _show(self, stage: str, state: str, plain: str = "", new: bool = False, **bar: Any) -> None:
        now = time.monotonic()
        if self._bar is not None:
            self._bar.update(self._task, description=f"{self._name}: {stage}", state=state, **bar)
        elif new or now - self._last_plain > 2:  # seconds between two plain lines of one thing
            self._stage, self._last_plain = stage, now
            self.say(f"{self._name}: {stage} ... {plain or state}")


class BatchLines(ProgressLines):
    """Shows how far a batch is; use as a context manager."""

    def show(self, progress: BatchProgress) -> None:
        """Show a scan that has ended, or a note."""
        if progress.note:
            self.say(f"batch: {progress.note}")
        last = progress.last
        if last is not None and last.status == "failed" and self._bar is not None:
            self.say(f"{last.name}: failed: {last.reason}")
        parts = [f"{progress.done} of {progress.total} done"]
        if progress.failed:
            parts.append(f"{progress.failed} failed")
        if progress.scans_per_hour is not None:
            parts.append(f"{progress.scans_per_hour:.0f} scans/h")
        if progress.left_s and progress.left:
            parts.append(f"{progress.left_s / 60:.1f} min left")
        if self._bar is not None or (last is not None and progress.left):
            ended = progress.done + progress.failed
            self._show("scans", ", ".join(parts), completed=ended, total=progress.total)
