"""Run tasks in workers, local or of a cluster, also when workers die, and as many as memory carries."""

import os
import queue
import re
import secrets
import time
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from pathlib import Path
from typing import Any

from scan2albedo.batch import worker
from scan2albedo.batch.records import BatchScanRecord, Layout
from scan2albedo.batch.worker import ScanTask
from scan2albedo.core.arrays import Values
from scan2albedo.errors import BatchError, OutputError, Scan2AlbedoError, errors_of, needs_extra
from scan2albedo.io import limits
from scan2albedo.io.images import SUPPORTED_IMAGES, declared_pixels
from scan2albedo.io.load_scan import files_of_scan

_CAUSES = "for want of memory, or a library crashed"
_ONE_THREAD = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL", "NUMBA")}


def run_in_processes(tasks: Sequence[ScanTask], layout: Layout, jobs: int) -> Generator[BatchScanRecord]:
    """Yield the record of each task as it is finished by one of `jobs` local processes.

    Each process has an executor of its own, so that one that dies takes no other scan with it. Its scan is
    tried again at the end, alone, and has failed when its process dies once more. Raises `BatchError` when
    processes die again before they begin a scan.
    """
    from loky import ProcessPoolExecutor

    def start() -> ProcessPoolExecutor:
        arguments: Values = {"initializer": worker.begin_worker, "initargs": (os.getpid(),)}
        return ProcessPoolExecutor(1, env=_ONE_THREAD, **arguments)

    waiting = deque(tasks)
    suspects: deque[ScanTask] = deque()
    alone = False
    idle = [start() for _ in range(jobs)]
    running: dict[Future[BatchScanRecord], tuple[ScanTask, ProcessPoolExecutor]] = {}
    with warnings.catch_warnings():
        # loky replaces a worker whose memory grew, which is intended.
        warnings.filterwarnings("ignore", "A worker stopped while some jobs", UserWarning)
        try:
            while waiting or running or suspects:
                if not (waiting or running):
                    alone = True
                    waiting.append(suspects.popleft())
                while idle and waiting:
                    task = waiting.popleft()
                    executor = idle.pop()
                    running[executor.submit(worker.process_task, task)] = task, executor
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    task, executor = running.pop(future)
                    row: BatchScanRecord | None
                    try:
                        row = _answer(task, future)
                    except BrokenProcessPool as error:
                        executor = start()
                        row = _after_death(task, layout, _exit_codes(error), again=alone)
                    idle.append(executor)
                    if row is None:
                        suspects.append(task)
                    else:
                        yield row
        finally:
            # At once: they hold hundreds of MB each.
            for executor in (*idle, *(executor for _, executor in running.values())):
                executor.shutdown(kill_workers=True)


def _after_death(task: ScanTask, layout: Layout, exit_codes: str, *, again: bool) -> BatchScanRecord | None:
    """Return the record of a task whose process died; None when it is to be tried once more."""
    row, begun = layout.row(task.name), layout.started_at(task.name)
    layout.unmark(task.name)
    if row is not None and row.run == task.run:
        return row  # it died after the scan
    if begun is not None and _took_too_long(task, begun):
        return _failed(task, layout, f"took longer than {task.timeout_s:g} s (--timeout)")
    if not again:
        return None
    if begun is None:
        raise BatchError(
            f"worker processes die before they begin a scan ({exit_codes}); process one scan "
            "with `scan2albedo process`, or see `scan2albedo doctor`"
        )
    return _failed(task, layout, f"its worker died twice ({exit_codes}): {_CAUSES}")


def _took_too_long(task: ScanTask, begun: float) -> bool:
    return task.timeout_s is not None and time.time() - begun >= task.timeout_s


def _answer(task: ScanTask, future: Any) -> BatchScanRecord:
    """Return the record of a task that ended, also of one that raised whatever its libraries raise."""
    try:
        return future.result()
    except (BrokenProcessPool, OutputError):
        raise
    except Exception as error:  # noqa: BLE001
        return task.record("failed", _reason(error))


def run_on_cluster(
    tasks: Sequence[ScanTask], layout: Layout, address: str, on_jobs: Callable[[int], None]
) -> Generator[BatchScanRecord]:
    """Yield the record of each task as it is finished by the workers of a dask scheduler.

    A scan whose worker dies is given to others as often as the scheduler allows, and has failed then, as has
    one that raises in its worker. No more scans are handed out than there are workers: the scheduler counts
    a death against all scans that wait at a worker. `on_jobs` is called with the number of workers. Raises
    `MissingDependencyError` without distributed, `BatchError` when no scheduler or worker answers.
    """
    with needs_extra("cluster"):
        from distributed import Client
    said, faults = f"no dask scheduler answers at {address}", (OSError, TimeoutError, ValueError)
    with errors_of(said, BatchError, *faults, advice="check the address"):
        client = Client(address, set_as_default=False)
    with client:
        if not client.nthreads():
            raise BatchError(f"the scheduler at {address} has no worker; start one: dask worker {address}")
        on_jobs(len(client.nthreads()))
        waiting = deque(tasks)
        ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
        running: dict[Any, ScanTask] = {}  # dask forgets tasks whose futures nobody holds
        while waiting or running:
            while waiting and len(running) < max(len(client.nthreads()), 1):
                task = waiting.popleft()
                key = f"{task.name}-{secrets.token_hex(8)}"
                future = client.submit(worker.process_task, task, key=key, pure=False)
                running[future] = task
                future.add_done_callback(ended.put)
            future = ended.get()  # also of one that dask gave up, or whose result it lost
            task = running.pop(future)
            row = _answer(task, future)
            if future.status not in ("finished", "error"):  # its task did not end: nobody is there to run it
                raise BatchError(f"the dask scheduler at {address} is gone; --resume goes on with another")
            if row.reason.startswith("KilledWorker"):
                begun = layout.started_at(task.name)
                late = begun is not None and _took_too_long(task, begun)
                why = f"{_CAUSES}{'; it takes longer than --timeout' if late else ''} ({row.reason})"
                row = task.record("failed", f"its workers died each time it was tried: {why}")
            if row.status == "failed":
                layout.keep(row)
            yield row


def _failed(task: ScanTask, layout: Layout, reason: str) -> BatchScanRecord:
    row = task.record("failed", reason)
    layout.keep(row)
    return row


def _exit_codes(error: BaseException) -> str:
    found = re.search(r"\{([^}]*)\}", str(error))
    return found[1] if found else type(error).__name__


def _reason(error: BaseException) -> str:
    first = (str(error).strip().splitlines() or [""])[0]
    return f"{type(error).__name__}: {first}"


MB = 1 << 20
_KEPT_FREE = 0.1

_CGROUP_FILES = (
    ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
    ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
)


def worker_mb(
    scans: Iterable[Path],
    size: int,
    textures: str | Path | None = None,
    template: int = 0,
) -> float:
    """Return the expected peak of a worker with the largest scan.

    `size` is the geometry images' side, `textures` as in `load_scan`, `template` the side of a template's
    texture, whose colours, normals and marks are kept at once. An idle worker has 450 MB; a pixel of a
    picture takes 160 bytes, a byte of a mesh's file 25, a texel 400.
    """
    largest = 0.0
    for path in scans:
        total = 0.0
        with suppress(OSError, ValueError, Scan2AlbedoError):  # a scan that is missing
            for file in files_of_scan(path, textures):
                pixels = None
                if file.suffix.lower() in SUPPORTED_IMAGES:
                    with file.open("rb") as opened:
                        pixels = declared_pixels(opened.read(MB))  # metadata may stand before the size
                if pixels is not None and 0 < pixels <= limits.PIXELS:
                    total += pixels * 160.0
                else:
                    total += file.stat().st_size * 25.0
        largest = max(largest, total)
    # Of a template's texel: two triples of float32, two marks, and some of the means that fill it.
    texels = size * size * 400.0 + template * template * 30
    return 450.0 + (texels + largest) / MB


def job_limit(asked: int, worker: float) -> tuple[int, str]:
    """Return how many jobs fit into the available memory with `worker` MB each, and a note if not all do."""
    available = available_mb()
    jobs = max(1, min(asked, int((1 - _KEPT_FREE) * available / worker)))
    need = f"a worker may need {worker / 1024:.1f} GB and {available / 1024:.1f} GB are available"
    return jobs, f"{jobs} of {asked} jobs: {need}" if jobs < asked else ""


def available_mb() -> float:
    """Return the memory that may still be taken, of the machine or of its container."""
    import psutil

    available = float(psutil.virtual_memory().available)
    for limit, used in _CGROUP_FILES:
        with suppress(OSError, ValueError):  # no such container, or no limit ("max")
            available = min(available, int(Path(limit).read_text()) - int(Path(used).read_text()))
    return max(available, 0.0) / MB
