"""Results of earlier runs that can be kept."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

from scan2albedo.batch.layout import Layout, changed_file
from scan2albedo.batch.records import BatchScanRecord
from scan2albedo.batch.worker import ScanTask
from scan2albedo.errors import Scan2AlbedoError
from scan2albedo.io.input_hash import input_sha256

_READERS = 4


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
        if row.input_sha256 != input_sha256(task.path, task.options.textures):
            return None, "with a changed scan"
    except Scan2AlbedoError:
        return None, "without their scan"
    if changed_file(layout.out / task.name, row.files) is not None:
        return None, "with changed or missing files"
    return row, ""
