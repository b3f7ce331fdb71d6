"""Results of earlier runs that can be kept, and their leftovers."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from scan2albedo.batch.layout import Layout, changed_file
from scan2albedo.batch.records import BatchScanRecord
from scan2albedo.batch.worker import ScanTask
from scan2albedo.errors import Scan2AlbedoError
from scan2albedo.io.input_hash import input_sha256

_READERS = 4
_CLOCK_S = 2.0


@dataclass(frozen=True)
class Resumed:
    """Results of earlier runs, and the scans that remain.

    `kept` are, by name, scans whose record, input, options and files agree; `reasons` counts why scans are
    done again; `files_verified` counts files that were read and agree with their hash.
    """

    kept: dict[str, BatchScanRecord] = field(default_factory=dict)
    todo: tuple[ScanTask, ...] = ()
    reasons: dict[str, int] = field(default_factory=dict)
    files_verified: int = 0

    def note(self) -> str:
        """Return one line for the user."""
        why = ", ".join(f"{count} {reason}" for reason, count in self.reasons.items())
        detail = f" ({why})" if why else ""
        return f"kept {len(self.kept)} (hashes verified), {len(self.todo)} to do{detail}"


def verified(tasks: Sequence[ScanTask], layout: Layout) -> Resumed:
    """Read every result of earlier runs and return those that are still valid."""
    with ThreadPoolExecutor(_READERS) as readers:
        found = list(readers.map(lambda task: _looked_at(task, layout), tasks))
    kept = {row.name: row for row, _ in found if row is not None}
    reasons = Counter(reason for row, reason in found if row is None)
    todo = tuple(task for task in tasks if task.name not in kept)
    return Resumed(kept, todo, dict(reasons), sum(len(row.files) for row in kept.values()))


def _looked_at(task: ScanTask, layout: Layout) -> tuple[BatchScanRecord | None, str]:
    """Return the record of a result that is still valid, or None and why it is not."""
    row = layout.row(task.name)
    if row is None:
        return None, "not run"
    if row.status != "done":
        return None, "failed before"
    if row.options_sha256 != task.options_sha256:
        return None, "with other options"
    try:
        if row.input_sha256 != input_sha256(task.path):
            return None, "with a changed scan"
    except Scan2AlbedoError:
        return None, "without their scan"
    if changed_file(layout.out / task.name, row.files) is not None:
        return None, "with changed or missing files"
    return row, ""


def remove_leftovers(layout: Layout) -> int:
    """Remove what killed processes left half-written; return how many files and folders that were.

    Folders of processes that still run, of another command perhaps, stay.
    """
    removed = 0
    for folder in layout.out.glob(".*.part"):
        if folder.is_dir() and not _at_work(folder):
            shutil.rmtree(folder, ignore_errors=True)
            removed += 1
    for place in (layout.out, layout.rows):
        for file in place.glob(".*.part.*"):
            with suppress(OSError):
                file.unlink()
                removed += 1
    return removed


def _at_work(folder: Path) -> bool:
    """Return whether the process whose number is in a staging folder's name still runs."""
    import psutil

    try:
        process = psutil.Process(int(folder.name.rsplit("-", 2)[1]))
        # A later process may have the same number.
        return process.create_time() < folder.stat().st_mtime + _CLOCK_S
    except (IndexError, ValueError, OSError, psutil.Error):
        return False
