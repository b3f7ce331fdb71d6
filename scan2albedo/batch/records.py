"""Records of a batch, its scans and its report, the columns of its catalogue, and where all files are."""

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AwareDatetime, Field

from scan2albedo.core.arrays import Texts
from scan2albedo.core.raw_scan import lost_texture
from scan2albedo.errors import BatchError, Scan2AlbedoError
from scan2albedo.io.atomic import make_folder, write_text
from scan2albedo.io.records import (
    Count,
    Figures,
    Name,
    Number,
    OptionalNumber,
    PositiveCount,
    Record,
    read_record,
    write_record,
)
from scan2albedo.io.result_records import SHA256, RunRecord

BatchOutcome = Literal["done", "failed"]
BatchStatus = Literal["running", "ended", "interrupted"]
Sha256 = Annotated[str, Field(pattern=SHA256)]
_SHOWN = 10
"""Failures in the summary."""


class BatchScanRecord(Record):
    """The outcome of one scan: `OUT/.batch/rows/<name>.json`."""

    format_version: Literal[1] = 1
    run: str = Field(description="Of the batch's run that wrote it.")
    name: Name = Field(description="Of the result's folder.")
    source: str = Field(description="Path as the manifest has it.")
    status: BatchOutcome
    reason: str = Field("", description="Why it failed, one line.")
    model: str | None = Field(None, description="Name of the face model; none without one.")
    input_sha256: Sha256 | None = Field(None, description="See input_sha256; null when it cannot be read.")
    options_sha256: Sha256 = Field(description="Of the options, the version and the model's file.")
    seconds: OptionalNumber = Field(None, description="Wall-clock, files and hashes included.")
    cpu_seconds: OptionalNumber = Field(None, description="Of the worker's process.")
    peak_memory_mb: OptionalNumber = Field(None, description="Highest resident memory of the worker so far.")
    worker: str = Field("", description="Host and process.")
    finished_at: AwareDatetime
    metrics: Figures = Field(default={}, description="As in result.json.")
    timings_s: dict[str, Number] = Field(default={}, description="Wall-clock seconds of each stage.")
    plan_ran: Texts = ()
    plan_skipped: Texts = ()
    notes: Texts = Field(default=(), description="Repairs and warnings, as in result.json.")
    files: dict[str, Sha256] = Field(default={}, description="SHA-256 of every file of the result.")


class BatchFailure(Record):
    """A scan that failed."""

    name: str
    source: str
    reason: str


class BatchRecord(RunRecord):
    """The content of `batch.json`."""

    run: str = Field(description="Of the last run.")
    status: BatchStatus = Field(description="A run that was killed is still called running.")
    manifest: str = Field(description="Path as given.")
    options: Figures = Field(description="Of the batch; lines of the manifest may set others.")
    jobs: PositiveCount = Field(description="Processes that worked.")
    jobs_asked: PositiveCount
    scheduler: str | None = None
    started_at: AwareDatetime
    finished_at: AwareDatetime | None = None
    seconds: Number = Field(description="Of the last run.")
    scans: Count
    done: Count
    failed: Count
    not_run: Count
    kept: Count = Field(description="Done in an earlier run, files verified.")
    files_verified: Count
    scans_per_hour: OptionalNumber = Field(None, description="Of the last run, failed ones included.")
    failures: tuple[BatchFailure, ...] = ()
    notes: Texts = ()


@dataclass(frozen=True)
class BatchProgress:
    """How far a batch is."""

    total: int
    done: int = 0
    failed: int = 0
    kept: int = 0
    """`total`, `done`, `failed`, `kept`: scans; `done` counts those that were `kept` from an earlier run;
    `elapsed_s` is the wall-clock time of this one."""
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
    """The result of a batch in the folder `out`, which came as far as `progress`.

    `failures` are reasons by name, `jobs` processes, `files_verified` those of kept results, `notes` texts.
    """

    out: Path
    progress: BatchProgress
    failures: Mapping[str, str] = field(default_factory=dict)
    jobs: int = 1
    files_verified: int = 0
    notes: Texts = ()

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
        lines = ["batch: " + ", ".join(parts) + f"; files in {self.out}, doubts in its catalogue"]
        messages = [f"  failed: {name}: {reason}" for name, reason in self.failures.items()]
        messages += [f"  {note}" for note in self.notes if lost_texture((note,))]
        lines += messages[:_SHOWN]
        if len(messages) > _SHOWN:
            lines.append(f"  and {len(messages) - _SHOWN} more; all are in catalogue.parquet")
        return "\n".join(lines)


FIXED = {
    **dict.fromkeys(("name", "source", "status", "reason", "folder", "model"), "string"),
    **dict.fromkeys(("input_sha256", "options_sha256", "worker"), "string"),
    **dict.fromkeys(("seconds", "cpu_seconds", "peak_memory_mb"), "float64"),
    "finished_at": "timestamp",
    **dict.fromkeys(("plan_ran", "plan_skipped", "notes"), "string"),
}
"""Columns of every scan."""

STAGES = ("load", "register", "fit", "geometry_image", "albedo", "files")
"""Stages that have a column of seconds."""

FILES = ("albedo.exr", "albedo.png", "geometry_image.npz", "fitted.glb", "result.json", "overview.png")
"""Files that have a column of paths."""

_METRICS = {
    "": ("seconds",),
    "registration_": ("rmse_mm", "confidence", "converged"),
    "fit_residual_": ("mean_mm", "median_mm", "p95_mm"),
    "fit_": ("coverage", "flipped_faces", "scale", "converged"),
    "geometry_image_": ("coverage", "seen", "texel_area_mm2", "texel_area_p95_to_p5"),
    "albedo_": ("lights", "converged"),
    "albedo_parameters_": ("ambient", "sigma_rad", "light_distance_mm"),
    "albedo_parameters_specular_": ("strength", "exponent"),
    "albedo_uncertainty_": ("albedo_deviation", "direction_deviation_deg", "intensity_deviation"),
}
METRICS = {
    f"metrics_{start}{name}": "bool" if name == "converged" else "float64"
    for start, names in _METRICS.items()
    for name in names
}
"""Figures of `ProcessResult.metrics` that have a column even where no scan has them."""


def path_column(file: str) -> str:
    """Return the column that holds the path of a file: path_albedo_exr."""
    return f"path_{file.replace('.', '_')}"


def is_taken(name: str) -> bool:
    """Return whether a column of that name may be the catalogue's own."""
    folded = name.casefold()
    return folded in FIXED or folded.startswith(("metrics_", "seconds_", "path_"))


CATALOGUE, RECORD = "catalogue.parquet", "batch.json"


class Layout:
    """Paths of a batch, all absolute: `out` with `catalogue` and `record`, and below it the records of scans
    that were tried in `rows`, and marks of those that are being processed in `running`."""

    def __init__(self, out: str | Path) -> None:
        self.out = Path(os.path.normpath(Path(out).absolute()))
        self.catalogue, self.record = self.out / CATALOGUE, self.out / RECORD
        self.kept = self.out / ".batch"
        self.rows, self.running = self.kept / "rows", self.kept / "running"
        # In which files are made under hidden names; the user may have named a link as `out`.
        self.folders = (Path(os.path.realpath(self.out)), self.rows, self.running)
        self._run = self.kept / "run"  # names the only run whose workers may write here

    def row_file(self, name: str) -> Path:
        """Return where the record of a scan is."""
        return self.rows / f"{name}.json"

    def row(self, name: str) -> BatchScanRecord | None:
        """Return the record of a scan, None when it is missing or incomplete."""
        with suppress(Scan2AlbedoError):
            return read_record(self.row_file(name), BatchScanRecord)
        return None

    def keep(self, row: BatchScanRecord) -> None:
        """Write the record of a scan, whole or not at all."""
        make_folder(self.rows)
        write_record(self.row_file(row.name), row)

    def begin_run(self, run: str) -> None:
        """Make `run` the only one whose workers may write here."""
        make_folder(self.rows)
        self.end_run()
        make_folder(self.running)
        write_text(self._run, run)

    def end_run(self) -> None:
        """Keep remaining workers from writing here, and remove their marks."""
        with suppress(OSError):
            self._run.unlink()
        with suppress(OSError):
            for name in os.listdir(self.running):
                if self.started_at(name) is not None:
                    self.unmark(name)
            self.running.rmdir()

    def is_running(self, run: str) -> bool:
        """Return whether `run` is the one that may write here."""
        with suppress(OSError):
            return self._run.read_text(encoding="utf-8") == run
        return False

    def mark(self, name: str, started_at: float) -> None:
        """Note that a scan is being processed by this process since `started_at` (seconds since 1970)."""
        write_text(self.running / name, str(started_at))

    def started_at(self, name: str) -> float | None:
        """Return when processing of a scan began, None when it is not in progress."""
        mark = self.running / name
        with suppress(OSError, ValueError):
            if mark.is_file():  # a pipe may never end
                return float(mark.read_text(encoding="utf-8"))
        return None

    def unmark(self, name: str) -> None:
        """Remove the mark of a scan."""
        with suppress(OSError):
            (self.running / name).unlink()

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other batches out of the folder during the block; BatchError when one works there already."""
        import fcntl

        descriptor = os.open(make_folder(self.kept), os.O_RDONLY)
        try:
            with suppress(OSError):  # a file system without locks
                try:
                    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    raise BatchError(f"a batch works in {self.out}; wait, or choose another folder") from None
            yield
        finally:
            os.close(descriptor)
