"""How a batch goes, and how it ended."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from scan2albedo.batch.records import BatchScanRecord

_SHOWN = 10


@dataclass(frozen=True)
class BatchProgress:
    """How far a batch is."""

    total: int
    done: int = 0
    failed: int = 0
    kept: int = 0
    """`total`, `done`, `failed`, `kept`: scans; `done` counts those that were `kept` from an earlier run."""
    elapsed_s: float = 0.0
    last: BatchScanRecord | None = None
    """The scan that has just ended; None with a `note`, a message for the user."""
    note: str = ""

    @property
    def left(self) -> int:
        """Scans that have not ended."""
        return self.total - self.done - self.failed

    @property
    def scans_per_hour(self) -> float | None:
        """Scans that ended in this run; None before the first."""
        ended = self.done - self.kept + self.failed
        return 3600 * ended / self.elapsed_s if ended and self.elapsed_s > 0 else None

    @property
    def left_s(self) -> float | None:
        """Seconds that the rest will take at this rate."""
        rate = self.scans_per_hour
        return None if rate is None else 3600 * self.left / rate


@dataclass(frozen=True)
class BatchReport:
    """The result of a batch in the folder `out`.

    `failures` are reasons by name, `jobs` the processes that worked, `files_verified` of results that were
    kept, `notes` what was decided and found on the way, one sentence each.
    """

    out: Path
    progress: BatchProgress
    failures: Mapping[str, str] = field(default_factory=dict)
    jobs: int = 1
    files_verified: int = 0
    notes: tuple[str, ...] = ()

    def figures(self) -> dict[str, Any]:
        """Return the summary for JSON."""
        progress = self.progress
        return {
            "out": str(self.out),
            "scans": progress.total,
            "done": progress.done,
            "failed": progress.failed,
            "not_run": progress.left,
            "kept": progress.kept,
            "files_verified": self.files_verified,
            "jobs": self.jobs,
            "seconds": progress.elapsed_s,
            "scans_per_hour": progress.scans_per_hour,
            "failures": [{"name": name, "reason": reason} for name, reason in self.failures.items()],
            "notes": list(self.notes),
        }

    def summary(self) -> str:
        """Return a summary of a few lines for a person."""
        progress = self.progress
        kept = f" ({progress.kept} kept)" if progress.kept else ""
        parts = [f"{progress.done} of {progress.total} done{kept}"]
        parts += [f"{progress.failed} failed"] if progress.failed else []
        parts += [f"{progress.left} not run"] if progress.left else []
        parts.append(f"{progress.elapsed_s:.0f} s")
        if progress.scans_per_hour:
            parts.append(f"{progress.scans_per_hour:.0f} scans/h with {self.jobs} job{'s' * (self.jobs > 1)}")
        lines = ["batch: " + ", ".join(parts) + f"; files in {self.out}"]
        shown = list(self.failures.items())[:_SHOWN]
        lines += [f"  failed: {name}: {reason}" for name, reason in shown]
        if len(self.failures) > _SHOWN:
            lines.append(f"  and {len(self.failures) - _SHOWN} more; all are in catalogue.parquet")
        return "\n".join(lines)
