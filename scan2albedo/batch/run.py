"""`run_batch`: many scans, each in a worker, with a catalogue of the outcomes."""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import signal
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

from scan2albedo.batch.catalogue import catalogue_table, load_catalogue, write_catalogue
from scan2albedo.batch.execution import run_in_processes, run_on_cluster
from scan2albedo.batch.layout import Layout
from scan2albedo.batch.manifest import BatchManifest, read_manifest
from scan2albedo.batch.memory import job_limit
from scan2albedo.batch.records import FIXED, BatchFailure, BatchRecord, BatchScanRecord, BatchStatus
from scan2albedo.batch.report import BatchProgress, BatchReport
from scan2albedo.batch.resume import Resumed, verified
from scan2albedo.batch.worker import ScanTask
from scan2albedo.core.landmarks import AUTO
from scan2albedo.core.version import VERSION
from scan2albedo.errors import BatchError, ModelError, needs_extra
from scan2albedo.io.atomic import check_writable
from scan2albedo.io.input_hash import file_sha256, files_of_scan
from scan2albedo.io.leftovers import remove_leftovers
from scan2albedo.io.placed_landmarks import landmarks_file
from scan2albedo.io.records import installed_versions, read_record, write_record
from scan2albedo.pipeline.detected_landmarks import require_detector
from scan2albedo.pipeline.options import ProcessOptions

CATALOGUE_INTERVAL_S = 30.0
"""Seconds between two writings of the catalogue while scans are processed."""

OnBatchProgress = Callable[[BatchProgress], None]


def run_batch(
    manifest: str | Path | BatchManifest,
    out: str | Path,
    *,
    options: ProcessOptions | None = None,
    jobs: int | None = None,
    scheduler: str | None = None,
    resume: bool = False,
    timeout_s: float | None = None,
    on_progress: OnBatchProgress | None = None,
) -> BatchReport:
    """Return the report on many scans, each processed in a worker with one thread; failed ones stop no other.

    Parameters
    ----------
    manifest : path or BatchManifest
        A CSV file, a list of paths or a folder; see `read_manifest`.
    out : path
        Folder that gets a subfolder for each scan, `catalogue.parquet` and `batch.json`.
    options : ProcessOptions, optional
        For all scans; lines of the manifest may set their own unit, model, lights and seed.
    jobs : int, optional
        Local processes; one a core when omitted, and never more than fit into the available memory.
    scheduler : str, optional
        Address of a dask scheduler whose workers, with one thread each, process the scans instead. They need
        this package and the same paths.
    resume : bool
        Keep scans of earlier runs whose input, options and files still have the same hashes.
    timeout_s : float, optional
        Seconds after which a scan is given up, with its worker.
    on_progress : callable, optional
        Called with a `BatchProgress` whenever a scan has ended.

    Raises
    ------
    MissingDependencyError
        When a library of the extra `batch`, or `cluster` with a scheduler, is not installed.
    BatchError
        When this is no POSIX system, the manifest is at fault, `out` holds a batch already and `resume` is
        not given, another batch works there, or no worker can be started or reached.
    ModelError
        When a model's file is missing.
    OutputError
        When `out` cannot be written.
    ValueError
        For a number of jobs or seconds that is not positive.
    """
    if jobs is not None and jobs < 1:
        raise ValueError(f"jobs is {jobs}, expected at least 1")
    if timeout_s is not None and not timeout_s > 0:
        raise ValueError(f"timeout_s is {timeout_s}, expected seconds above 0")
    layout = Layout.of(out)
    if not isinstance(manifest, BatchManifest):
        manifest = read_manifest(manifest, leave_out=layout.out)
    _check_machine(scheduler)
    options = ProcessOptions() if options is None else options
    tasks = _tasks(manifest, layout, options, timeout_s)
    check_writable(layout.out)
    layout.refuse_links()
    with layout.locked():
        if layout.holds_a_batch() and not resume:
            raise BatchError(f"{out} holds a batch already; give --resume to go on, or another folder")
        _require_a_batch(layout)
        asked = jobs or _cores()
        run = _Run(manifest, layout, options, asked, scheduler, on_progress, tasks[0].run)
        return run.report(tasks, resume)


def _require_a_batch(layout: Layout) -> None:
    """Raise `BatchError` for a record, or without one a catalogue, that no batch wrote."""
    advice = "it was edited, cut short, or is none of a batch: move it away, or choose another folder"
    if os.path.lexists(layout.record):
        read_record(layout.record, BatchRecord, advice=advice, error=BatchError)
    elif os.path.lexists(layout.catalogue):
        found = load_catalogue(layout.catalogue).column_names
        if not set(FIXED) <= set(found):
            raise BatchError(f"{layout.catalogue}: is no catalogue of a batch; {advice}")


def _tasks(
    manifest: BatchManifest, layout: Layout, options: ProcessOptions, timeout_s: float | None
) -> list[ScanTask]:
    run, tasks = secrets.token_hex(8), []
    models: dict[str, str | None] = {}
    if not isinstance(options.model, str):
        raise ValueError("a batch's model is a file, 'default' or 'none': workers read it themselves")
    if options.model not in ("default", "none"):
        options = replace(options, model=str(Path(options.model).absolute()))
    if options.landmarks is not None:
        options = replace(options, landmarks=_landmarks_of_all(options.landmarks, len(manifest.scans)))
    if options.textures is not None:
        options = replace(options, textures=str(Path(options.textures).absolute()))
    for scan in manifest.scans:
        chosen = scan.options(options, manifest.folder)
        model = str(chosen.model)
        if model not in models:
            models[model] = _model_sha256(model)
        tasks.append(
            ScanTask(
                name=scan.name,
                source=scan.source,
                path=str(scan.path),
                out=str(layout.out),
                options=chosen,
                options_sha256=_options_sha256(chosen, models[model], scan.path),
                model_sha256=models[model],
                run=run,
                version=VERSION,
                timeout_s=timeout_s,
            )
        )
    if any(task.options.landmarks_detected for task in tasks):
        require_detector()
    return tasks


def _model_sha256(model: str) -> str | None:
    """Return the SHA-256 of a model's or template's files, None for "none"; without them a `ModelError`."""
    if model == "none":
        return None
    path = Path(_default_model() if model == "default" else model)
    arrays = path.with_suffix(".npz")
    try:
        files = [path, arrays] if path.suffix.lower() == ".json" else [*files_of_scan(path)]
        return hashlib.sha256("".join(file_sha256(f) for f in files if f.exists()).encode()).hexdigest()
    except OSError as error:
        raise ModelError(
            f"{model}: {error.strerror or error}; give a model's or a template's file"
        ) from error


def _landmarks_of_all(landmarks: Any, count: int) -> str:
    """Return the absolute path of a batch's landmarks; ValueError for those that cannot be of all scans."""
    if isinstance(landmarks, str) and landmarks == AUTO:
        return AUTO
    if not isinstance(landmarks, str) or (count > 1 and not Path(landmarks).is_dir()):
        raise ValueError("a batch's landmarks are a folder with files named after the scans, or auto")
    return str(Path(landmarks).absolute())


def _options_sha256(options: ProcessOptions, model_hash: str | None, scan: Path) -> str:
    """Return the SHA-256 of options, package version, model and the landmarks of a scan."""
    hashed = {"version": VERSION, "model_sha256": model_hash, **asdict(options)}
    if options.model not in ("default", "none"):
        hashed["model"] = Path(str(options.model)).name  # its place does not count
    del hashed["textures"]  # those that a scan uses are part of the input
    del hashed["landmarks"]
    if options.landmarks == AUTO:
        hashed["landmarks"] = AUTO
    elif isinstance(options.landmarks, str) and (file := landmarks_file(options.landmarks, scan)) is not None:
        hashed["landmarks"] = file_sha256(file) if file.is_file() else "missing"
    return hashlib.sha256(json.dumps(hashed, sort_keys=True).encode()).hexdigest()


@cache
def _default_model() -> Path:
    from scan2albedo import face_model

    return Path(str(face_model.__file__)).parent / "data" / "afm.json"


@dataclass
class _Run:
    """One run of a batch: what has ended, and when the catalogue was written."""

    manifest: BatchManifest
    layout: Layout
    options: ProcessOptions
    asked: int
    scheduler: str | None
    on_progress: OnBatchProgress | None
    run: str
    rows: dict[str, BatchScanRecord] = field(default_factory=dict)
    resumed: Resumed = field(default_factory=Resumed)
    notes: list[str] = field(default_factory=list)
    jobs: int = 1
    started_at: datetime = field(default_factory=lambda: datetime.now(UTC))
    start: float = field(default_factory=time.monotonic)
    written: float = 0.0

    def report(self, tasks: Sequence[ScanTask], resume: bool) -> BatchReport:
        """Process the remaining scans and return the report on all."""
        self.layout.begin_run(self.run)
        status: BatchStatus = "interrupted"
        try:
            todo = self.taken_up(tasks) if resume else tasks
            self.start = time.monotonic()
            self.write("running")
            # Closed at once when Ctrl-C ends the loop: workers hold hundreds of MB each.
            with closing(self.processed(todo)) as ended:
                for row in ended:
                    self.rows[row.name] = row
                    self.show(last=row)
                    if time.monotonic() - self.written > CATALOGUE_INTERVAL_S:
                        self.write("running")
            status = "ended"
        finally:
            with _undisturbed():
                self.layout.end_run()
                self.take_finished()
                remove_leftovers(*self.layout.folders)
                self.write(status)
        return BatchReport(
            self.layout.out,
            self.progress(),
            self.failures(),
            self.jobs,
            self.resumed.files_verified,
            tuple(self.notes),
        )

    def take_finished(self) -> None:
        """Take up scans that a worker finished, but whose answer was not awaited when the run was ended."""
        for name in (scan.name for scan in self.manifest.scans if scan.name not in self.rows):
            row = self.layout.row(name)
            if row is not None and row.run == self.run:
                self.rows[name] = row

    def taken_up(self, tasks: Sequence[ScanTask]) -> Sequence[ScanTask]:
        """Keep valid results of earlier runs, remove their leftovers, and return the other tasks."""
        if removed := remove_leftovers(*self.layout.folders):
            self.note(f"removed {removed} half-written files and folders of a run that was killed")
        self.resumed = verified(tasks, self.layout)
        self.rows |= self.resumed.kept
        self.note(self.resumed.note())
        return self.resumed.todo

    def processed(self, tasks: Sequence[ScanTask]) -> Generator[BatchScanRecord]:
        if tasks and self.scheduler is not None:
            yield from run_on_cluster(tasks, self.layout, self.scheduler, self.set_jobs)
        elif tasks:
            yield from run_in_processes(tasks, self.layout, self.limited)

    def set_jobs(self, jobs: int) -> None:
        self.jobs = jobs

    def limited(self, tasks: Sequence[ScanTask]) -> int:
        """Return how many processes to use for these tasks: as many as fit into memory now."""
        asked = min(self.asked, len(tasks))
        peaks = [row.peak_memory_mb for row in self.rows.values() if row.run == self.run]
        limit = job_limit(
            asked,
            [Path(task.path) for task in tasks],
            max(task.options.texels for task in tasks),
            max((peak for peak in peaks if peak is not None), default=0.0),
            tasks[0].options.textures,
        )
        if note := limit.note(asked):
            self.note(note)
        self.jobs = limit.jobs
        return limit.jobs

    def note(self, text: str) -> None:
        self.notes.append(text)
        self.show(note=text)

    def show(self, last: BatchScanRecord | None = None, note: str = "") -> None:
        if self.on_progress is not None:
            self.on_progress(replace(self.progress(), last=last, note=note))

    def progress(self) -> BatchProgress:
        failed = len(self.failures())
        return BatchProgress(
            total=len(self.manifest.scans),
            done=len(self.rows) - failed,
            failed=failed,
            kept=len(self.resumed.kept),
            elapsed_s=time.monotonic() - self.start,
        )

    def failures(self) -> dict[str, str]:
        rows = (self.rows.get(scan.name) for scan in self.manifest.scans)
        return {row.name: row.reason for row in rows if row is not None and row.status == "failed"}

    def write(self, status: BatchStatus) -> None:
        """Write the catalogue and the record of the batch, each whole or not at all."""
        self.written = time.monotonic()
        write_catalogue(self.layout.catalogue, catalogue_table(self.manifest, self.rows))
        write_record(self.layout.record, self.record(status))

    def record(self, status: BatchStatus) -> BatchRecord:
        progress, failures = self.progress(), self.failures()
        return BatchRecord(
            scan2albedo_version=VERSION,
            versions=installed_versions(),
            run=self.run,
            status=status,
            manifest=str(self.manifest.path),
            options=asdict(self.options),
            jobs=self.jobs,
            jobs_asked=self.asked,
            scheduler=self.scheduler,
            started_at=self.started_at,
            finished_at=None if status == "running" else datetime.now(UTC),
            seconds=progress.elapsed_s,
            scans=progress.total,
            done=progress.done,
            failed=progress.failed,
            not_run=progress.left,
            kept=progress.kept,
            files_verified=self.resumed.files_verified,
            scans_per_hour=progress.scans_per_hour,
            failures=tuple(
                BatchFailure(name=scan.name, source=scan.source, reason=failures[scan.name])
                for scan in self.manifest.scans
                if scan.name in failures
            ),
            notes=tuple(self.notes),
        )


_POSIX = os.name == "posix"


def _check_machine(scheduler: str | None) -> None:
    """Refuse a machine that is not POSIX, before any work.

    Others lack the lock on the folder (`fcntl`), the time limit of a scan (`signal.setitimer`), the peak
    memory of a worker (`resource`) and the change of parent by which a worker notices that it is an orphan.
    """
    if not _POSIX:
        raise BatchError(
            "batches need Linux or macOS; here, process scans one after the other with `scan2albedo process`"
        )
    with needs_extra("batch"):
        import loky  # noqa: F401
        import psutil  # noqa: F401
        import pyarrow  # noqa: F401
    if scheduler is not None:
        with needs_extra("cluster"):
            import distributed  # noqa: F401


def _cores() -> int:
    from loky import cpu_count

    return int(cpu_count())


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Let neither Ctrl-C nor SIGTERM end the block."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, signal.SIG_IGN) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
