"""`run_batch`: many scans, each in a worker, with a catalogue of the outcomes."""

import functools
import hashlib
import json
import os
import secrets
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from scan2albedo import face_model
from scan2albedo.batch import records
from scan2albedo.batch.catalogue import catalogue_table, load_catalogue, write_catalogue
from scan2albedo.batch.execution import job_limit, run_in_processes, run_on_cluster, worker_mb
from scan2albedo.batch.manifest import BatchManifest, read_manifest
from scan2albedo.batch.records import (
    BatchProgress,
    BatchRecord,
    BatchReport,
    BatchScanRecord,
    BatchStatus,
    Layout,
)
from scan2albedo.batch.worker import ScanTask
from scan2albedo.core.arrays import attributes
from scan2albedo.core.landmarks import AUTO
from scan2albedo.core.raw_scan import lost_texture
from scan2albedo.core.version import VERSION
from scan2albedo.errors import BatchError, ModelError, Scan2AlbedoError, needs_extra
from scan2albedo.io.atomic import check_writable
from scan2albedo.io.input_hash import file_sha256
from scan2albedo.io.landmark_files import landmarks_file
from scan2albedo.io.leftovers import JOURNAL, remove_leftovers
from scan2albedo.io.linear_model_files import LinearFaceModel
from scan2albedo.io.load_scan import files_of_scan
from scan2albedo.io.publication import signals_held
from scan2albedo.io.records import installed_versions, read_record, write_record
from scan2albedo.pipeline.detected_landmarks import require_detector
from scan2albedo.pipeline.options import ProcessOptions

_POSIX = os.name == "posix"


def run_batch(
    manifest: str | Path | BatchManifest,
    out: str | Path,
    *,
    options: ProcessOptions | None = None,
    jobs: int | None = None,
    scheduler: str | None = None,
    resume: bool = False,
    timeout_s: float | None = None,
    on_progress: Callable[[BatchProgress], None] | None = None,
) -> BatchReport:
    """Return the report on many scans, each processed in a worker with one thread; failed ones stop no other.

    Raises MissingDependencyError without the libraries of the extra `batch`, or `cluster` with a scheduler;
    BatchError when this is no POSIX system, the manifest is at fault, `out` holds a batch and `resume` is not
    given, another batch works there, or no worker can be started or reached; ModelError for a missing model,
    OutputError when `out` cannot be written, ValueError when jobs or seconds are not positive.

    Parameters
    ----------
    manifest : path or BatchManifest
        A CSV file, a list of paths or a folder; see `read_manifest`.
    out : path
        Folder that gets a subfolder for each scan, `catalogue.parquet` and `batch.json`.
    options : ProcessOptions, optional
        For all scans; lines of the manifest may set their own unit, model, lights and seed. Scans with the
        same `person` are one task: see `process_person`.
    jobs : int, optional
        Local processes; one a core when omitted, and never more than fit into the available memory.
    scheduler : str, optional
        Address of a dask scheduler whose workers, with one thread each, process the scans instead. They need
        this package and the same paths.
    resume : bool
        Keep scans of earlier runs whose input, options and files still have the same hashes.
    timeout_s : float, optional
        Seconds after which a scan is given up, with its worker; of a person, for each of the scans.
    on_progress : callable, optional
        Called with a `BatchProgress` whenever a scan has ended.
    """
    if jobs is not None and jobs < 1:
        raise ValueError(f"jobs is {jobs}, expected at least 1")
    if timeout_s is not None and not timeout_s > 0:
        raise ValueError(f"timeout_s is {timeout_s}, expected seconds above 0")
    layout = Layout(out)
    if not isinstance(manifest, BatchManifest):
        manifest = read_manifest(manifest, leave_out=layout.out)
    # Others lack the lock on the folder (`fcntl`), the time limit of a scan (`signal.setitimer`), the peak
    # memory of a worker (`resource`) and the change of parent by which a worker notices that it is an orphan.
    if not _POSIX:
        raise BatchError("batches need Linux or macOS; process scans one by one with `scan2albedo process`")
    with needs_extra("batch"):
        import psutil  # noqa: F401
        import pyarrow  # noqa: F401
        from loky import cpu_count
    if scheduler is not None:
        with needs_extra("cluster"):
            import distributed  # noqa: F401
    options = ProcessOptions() if options is None else options
    tasks = _tasks(manifest, layout, options, timeout_s)
    check_writable(layout.out)
    for folder in (layout.rows.parent, layout.rows, layout.running):
        if folder.is_symlink():
            raise BatchError(f"{folder}: is a link, and links are not followed; remove it")
    with layout.locked():
        begun = layout.record.exists() or layout.catalogue.exists() or any(layout.rows.glob("*.json"))
        if begun and not resume:
            raise BatchError(f"{out} holds a batch already; give --resume to go on, or another folder")
        advice = "it was edited, cut short, or is none of a batch: move it away, or choose another folder"
        if os.path.lexists(layout.record):
            read_record(layout.record, BatchRecord, advice=advice, error=BatchError)
        elif os.path.lexists(layout.catalogue) and set(records.FIXED) - set(load_catalogue(out).column_names):
            raise BatchError(f"{layout.catalogue}: is not a catalogue of a batch; {advice}")
        run = _Run(manifest, layout, options, jobs or int(cpu_count()), scheduler, on_progress, tasks[0].run)
        return run.report(tasks, resume)


def _tasks(
    manifest: BatchManifest, layout: Layout, options: ProcessOptions, timeout_s: float | None
) -> list[ScanTask]:
    run, tasks = secrets.token_hex(8), []
    paths: dict[str, Any] = {}
    for name in ("model", "landmarks", "linear_model", "textures"):
        value = getattr(options, name)
        if value is None or (isinstance(value, str) and value in ("default", "none", AUTO)):
            continue
        if not isinstance(value, str | Path):
            raise ValueError(f"a batch's {name} is a file or a folder: workers read it themselves")
        paths[name] = str(Path(value).absolute())
    several = sum(len(scan.members) or 1 for scan in manifest.scans) > 1
    if several and "landmarks" in paths and not Path(paths["landmarks"]).is_dir():
        raise ValueError("a batch's landmarks are a folder with files named after the scans, or auto")
    options = replace(options, **paths)
    sha256_of_model = functools.cache(_model_sha256)
    for scan in manifest.scans:
        chosen = scan.options(options, manifest.folder)
        if scan.members and chosen.model == "none":
            raise BatchError(f"{scan.where}: a person needs the model of a face: leave the model 'none' out")
        members = scan.members or (scan,)
        model_sha256 = sha256_of_model(str(chosen.model))
        tasks.append(
            ScanTask(
                name=scan.name,
                source=scan.source,
                path=str(scan.path),
                out=str(layout.out),
                options=chosen,
                options_sha256=_options_sha256(chosen, model_sha256, [member.path for member in members]),
                model_sha256=model_sha256,
                run=run,
                version=VERSION,
                timeout_s=timeout_s and timeout_s * len(members),
                members=tuple((member.name, str(member.path)) for member in scan.members),
            )
        )
    if any(task.options.landmarks_detected for task in tasks):
        require_detector()
    return tasks


def _model_sha256(model: str) -> str | None:
    """Return the hash of all files of a model or a template; None for no model."""
    if model == "none":
        return None
    path = Path(face_model.__path__[0], "data", "afm.json") if model == "default" else Path(model)
    try:
        of_json = [path, path.with_suffix(".npz")]
        parts = of_json if path.suffix.lower() == ".json" else files_of_scan(path)
        hashes = "".join(file_sha256(part) for part in parts if part.exists())
    except OSError as error:
        raise ModelError(
            f"{model}: {error.strerror or error}; give a model's or a template's file"
        ) from error
    return hashlib.sha256(hashes.encode()).hexdigest()


def _options_sha256(options: ProcessOptions, model_sha256: str | None, scans: Sequence[Path]) -> str:
    """Return the hash of whatever changes a result beside the scans, and of nothing else."""
    hashed = {"version": VERSION, "model_sha256": model_sha256, **asdict(options)}
    if options.model not in ("default", "none"):
        hashed["model"] = Path(str(options.model)).name  # its place does not count
    if isinstance(linear := hashed.pop("linear_model"), str):
        hashed["linear_model_sha256"] = LinearFaceModel.load(linear).sha256
    del hashed["textures"]  # those that a scan uses are part of the input
    folder = hashed.pop("landmarks")
    if folder == AUTO:
        hashed["landmarks"] = AUTO
    elif isinstance(folder, str):
        files = [landmarks_file(folder, scan) for scan in scans]
        found = ["" if file is None else file_sha256(file) if file.is_file() else "missing" for file in files]
        if any(found):
            hashed["landmarks"] = "/".join(found)
    return hashlib.sha256(json.dumps(hashed, sort_keys=True).encode()).hexdigest()


def _still_valid(task: ScanTask, layout: Layout) -> tuple[BatchScanRecord | None, str]:
    """Return the record of a result of an earlier run that is still valid, or None and why it is not."""
    folder = layout.out / task.name
    remove_leftovers(folder)
    row = layout.row(task.name)
    if row is None:
        return None, "not run"
    if row.status != "done":
        return None, "failed before"
    if row.options_sha256 != task.options_sha256:
        return None, "with other options"
    try:
        if row.input_sha256 != task.input_sha256():
            return None, "with a changed scan"
    except Scan2AlbedoError:
        return None, "without their scan"
    changed = None, "with changed or missing files"
    if folder.is_symlink() or os.path.lexists(folder / JOURNAL):
        return changed
    for name, sha256 in row.files.items():
        with suppress(OSError):
            # The record may have been edited: nothing outside the folder is read.
            parts = Path(name).parts
            inside = len(parts) < 3 and not {"..", "/"} & {*parts}
            if inside and (folder / name).is_file() and file_sha256(folder / name) == sha256:
                continue
        return changed
    return row, ""


@dataclass
class _Run:
    """One run of a batch: what has ended, and when the catalogue was written."""

    manifest: BatchManifest
    layout: Layout
    options: ProcessOptions
    asked: int
    scheduler: str | None
    on_progress: Callable[[BatchProgress], None] | None
    run: str
    rows: dict[str, BatchScanRecord] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    jobs: int = 1
    started_at: datetime = field(default_factory=lambda: datetime.now(UTC))
    start: float = field(default_factory=time.monotonic)
    written: float = 0.0

    def report(self, tasks: Sequence[ScanTask], resume: bool) -> BatchReport:
        self.layout.begin_run(self.run)
        status: BatchStatus = "interrupted"
        todo = tasks
        try:
            if resume:  # keeps valid results of earlier runs, and removes their leftovers
                if removed := remove_leftovers(*self.layout.folders):
                    what = "half-written files and folders of a run that was killed"
                    self.show(note=f"removed {removed} {what}")
                with ThreadPoolExecutor() as readers:
                    found = list(readers.map(lambda task: _still_valid(task, self.layout), tasks))
                self.rows |= {row.name: row for row, _ in found if row is not None}
                todo = [task for task in tasks if task.name not in self.rows]
                reasons = Counter(reason for row, reason in found if row is None)
                why = ", ".join(f"{count} {reason}" for reason, count in reasons.items())
                detail = f" ({why})" if why else ""
                self.show(note=f"kept {len(self.rows)} (hashes verified), {len(todo)} to do{detail}")
            self.start = time.monotonic()
            self.write("running")
            # Closed at once when Ctrl-C ends the loop: workers hold hundreds of MB each.
            if todo and self.scheduler is not None:
                set_jobs = functools.partial(setattr, self, "jobs")
                ended = run_on_cluster(todo, self.layout, self.scheduler, set_jobs)
            else:
                ended = run_in_processes(todo, self.layout, self.limited(todo) if todo else 0)
            with closing(ended):
                for row in ended:
                    self.rows[row.name] = row
                    self.show(last=row)
                    if time.monotonic() - self.written > 30:  # seconds
                        self.write("running")
            status = "ended"
        finally:
            with signals_held():
                self.layout.end_run()
                # Scans that a worker finished, but whose answer was not awaited when the run was ended.
                for scan in self.manifest.scans:
                    finished = None if scan.name in self.rows else self.layout.row(scan.name)
                    if finished is not None and finished.run == self.run:
                        self.rows[scan.name] = finished
                failed = (self.layout.out / row.name for row in self.rows.values() if row.status == "failed")
                remove_leftovers(*self.layout.folders, *failed)
                self.write(status)
        return self.outcome()

    def limited(self, tasks: Sequence[ScanTask]) -> int:
        """Return how many processes to use for these tasks: as many as fit into memory."""
        asked = min(self.asked, len(tasks))
        paths = [Path(path) for task in tasks for path in task.paths]
        texels = max(task.options.texels for task in tasks)
        painted = (task.options for task in tasks if task.options.model not in ("default", "none"))
        template = max((options.texture_size for options in painted), default=0)
        worker = worker_mb(paths, texels, tasks[0].options.textures, template)
        self.jobs, note = job_limit(asked, worker)
        if note:
            self.show(note=note)
        return self.jobs

    def show(self, last: BatchScanRecord | None = None, note: str = "") -> None:
        """Tell the caller of a scan that has ended, or of a note, which is kept."""
        self.notes += [note] if note else []
        if self.on_progress is not None:
            self.on_progress(replace(self.outcome().progress, last=last, note=note))

    def write(self, status: BatchStatus) -> None:
        self.written = time.monotonic()
        write_catalogue(self.layout.catalogue, catalogue_table(self.manifest, self.rows))
        outcome = self.outcome().figures()
        del outcome["out"]
        sources = {scan.name: scan.source for scan in self.manifest.scans}
        outcome["failures"] = [{**one, "source": sources[one["name"]]} for one in outcome["failures"]]
        record = BatchRecord(
            scan2albedo_version=VERSION,
            versions=installed_versions(),
            **attributes(self, "run", "scheduler", "started_at"),
            status=status,
            manifest=str(self.manifest.path),
            options=asdict(self.options),
            jobs_asked=self.asked,
            finished_at=None if status == "running" else datetime.now(UTC),
            **outcome,
        )
        write_record(self.layout.record, record)

    def outcome(self) -> BatchReport:
        rows = [self.rows[scan.name] for scan in self.manifest.scans if scan.name in self.rows]
        failures = {row.name: row.reason for row in rows if row.status == "failed"}
        kept = [row for row in rows if row.run != self.run]
        progress = BatchProgress(
            total=len(self.manifest.scans),
            done=len(rows) - len(failures),
            failed=len(failures),
            kept=len(kept),
            elapsed_s=time.monotonic() - self.start,
        )
        verified = sum(len(row.files) for row in kept)
        lost = [f"{row.name}: {note}" for row in rows if (note := lost_texture(row.notes))]
        return BatchReport(self.layout.out, progress, failures, self.jobs, verified, (*self.notes, *lost))
