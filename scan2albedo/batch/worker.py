"""What a worker does: one scan after the other in one thread, each with a record of how it ended."""

from __future__ import annotations

import hashlib
import os
import platform
import signal
import sys
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from scan2albedo.batch.records import BatchOutcome, BatchScanRecord, Layout
from scan2albedo.core.arrays import Texts, Values
from scan2albedo.errors import BatchError, Scan2AlbedoError, one_line
from scan2albedo.io.input_hash import file_sha256, input_sha256
from scan2albedo.io.run_folder import RunFolder

if TYPE_CHECKING:
    from scan2albedo.pipeline.options import ProcessOptions
    from scan2albedo.templates import AnnotatedFaceModel

_ONE_AT_A_TIME = threading.Lock()


@dataclass(frozen=True)
class ScanTask:
    """One scan to process, or a person's `members`, names and paths; absolute, for workers may run elsewhere.

    `run` names the batch's run, `version` the package's; after `timeout_s` seconds the worker ends itself.
    """

    name: str
    source: str
    path: str
    out: str
    options: ProcessOptions
    options_sha256: str
    model_sha256: str | None
    run: str
    version: str
    timeout_s: float | None = None
    members: tuple[tuple[str, str], ...] = ()

    @property
    def paths(self) -> Texts:
        """Of all its scans."""
        return tuple(path for _, path in self.members) or (self.path,)

    def input_sha256(self) -> str:
        """Return the hash of its scan, for a person that of the scans' names and hashes."""
        if not self.members:
            return input_sha256(self.path, self.options.textures)
        text = ""
        for name, path in self.members:
            text += f"{name}:"
            with suppress(Scan2AlbedoError):  # one that cannot be read is left out, as long as that is so
                text += input_sha256(path, self.options.textures)
        return hashlib.sha256(text.encode()).hexdigest()

    def record(self, status: BatchOutcome, reason: str = "", **figures: Any) -> BatchScanRecord:
        """Return a record of this scan, finished now."""
        return BatchScanRecord(
            run=self.run,
            name=self.name,
            source=self.source,
            status=status,
            reason=one_line(reason),
            options_sha256=self.options_sha256,
            finished_at=datetime.now(UTC),
            **figures,
        )


def begin_worker(parent: int) -> None:
    """Leave Ctrl-C to the parent, and end when it has ended."""

    def end_with_parent() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=end_with_parent, daemon=True).start()


def process_task(task: ScanTask) -> BatchScanRecord:
    """Process one scan, write its files and its record, and return the record, also of any failure.

    An alarm ends the process when it takes too long, even inside compiled code that no exception ends.
    """
    import resource

    layout = Layout(task.out)
    earlier = layout.row(task.name)
    if earlier is not None and earlier.run == task.run:
        return earlier  # a scheduler asks again when it has lost the answer
    with _ONE_AT_A_TIME:
        with suppress(Scan2AlbedoError):
            layout.mark(task.name, time.time())
        if task.timeout_s is not None:
            signal.setitimer(signal.ITIMER_REAL, task.timeout_s)
        try:
            start, cpu = time.perf_counter(), time.process_time()
            known: Values = {"worker": f"{platform.node()}:{os.getpid()}"}
            status: BatchOutcome = "done"
            try:
                known |= _processed(task, layout)
            except Exception as error:  # noqa: BLE001  one bad scan never stops the others, whatever it raises
                name = "" if isinstance(error, Scan2AlbedoError) else f"{type(error).__name__}: "
                status, known["reason"] = "failed", f"{name}{error}"
                known["notes"] = tuple(getattr(error, "__notes__", ()))  # what the stages warned of before
                with suppress(Scan2AlbedoError):
                    known["input_sha256"] = task.input_sha256()
                if (layout.out / task.name / "result.json").exists():
                    known["notes"] += ("the result of an earlier run is still in its folder",)
            known["seconds"] = time.perf_counter() - start
            known["cpu_seconds"] = time.process_time() - cpu
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # KB, on macOS bytes
            known["peak_memory_mb"] = peak / (1 << 20 if sys.platform == "darwin" else 1 << 10)
            row = task.record(status, **known)
            if layout.is_running(task.run):
                layout.keep(row)
            return row
        finally:
            if task.timeout_s is not None:
                signal.setitimer(signal.ITIMER_REAL, 0)
            layout.unmark(task.name)


def _processed(task: ScanTask, layout: Layout) -> Values:
    from scan2albedo.core.version import VERSION

    if task.version != VERSION:
        raise BatchError(f"the worker has scan2albedo {VERSION}, the batch {task.version}; install one")
    from threadpoolctl import threadpool_limits

    # Loads the libraries that are to be limited to one thread: processes share the cores.
    from scan2albedo.pipeline.person import process_person
    from scan2albedo.pipeline.process import FILES, process, write_result
    from scan2albedo.pipeline.result import ProcessResult

    with threadpool_limits(limits=1):
        folder = layout.out / task.name
        earlier = layout.row(task.name)
        recorded = () if earlier is None else tuple(earlier.files)
        RunFolder(folder, FILES, recorded).check()  # refused before any work
        model = _model(task.options.model, task.model_sha256)
        chosen = task.options.arguments() | {"model": model, "name": task.name}

        def go_on(row: object = None) -> None:
            if not layout.is_running(task.run):
                raise BatchError("the batch has ended; nothing is written")

        timings_s = dict[str, float]()
        sha256 = task.input_sha256() if task.members else None  # before, for the scans may change meanwhile
        if task.members:
            scans = dict(task.members)
            result: ProcessResult = process_person(scans, layout.out, on_progress=go_on, **chosen)
        else:
            result = process(task.path, **chosen)
            go_on()
            begin = time.perf_counter()
            files, pictures = task.options.files, task.options.pictures
            write_result(result, layout.out, files=files, pictures=pictures, recorded=recorded)
            timings_s = {"files": time.perf_counter() - begin}
        folders = [folder, *(folder / name for name, _ in task.members)]
        written = [path for place in folders if place.is_dir() for path in sorted(place.iterdir())]
        steps = result.plan.steps
    return {
        "input_sha256": sha256 or result.input_sha256,
        "timings_s": {**result.timings_s, **timings_s},
        "files": {
            str(path.relative_to(folder)): file_sha256(path)
            for path in written
            if path.is_file() and FILES.holds(path.name)
        },
        "model": str(result.options["model"]),
        "metrics": result.metrics(),
        "plan_ran": tuple(dict.fromkeys(step.stage for step in steps if step.level == "did")),
        "plan_skipped": tuple(dict.fromkeys(step.stage for step in steps if step.level == "left out")),
        "notes": result.notes,
    }


@lru_cache(4)
def _model(model: str, sha256: str | None) -> AnnotatedFaceModel | str:
    """Return the model, read once a worker as long as its files' hash is the same."""
    from scan2albedo.templates import chosen_model

    return chosen_model(model) or "none"
