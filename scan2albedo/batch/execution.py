"""Run tasks in workers, local or of a cluster, also when workers die, and as many as memory carries."""

import os
import queue
import re
import secrets
import time
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any

from scan2albedo.batch import worker
from scan2albedo.batch.records import BatchScanRecord, Layout
from scan2albedo.batch.worker import ScanTask
from scan2albedo.errors import BatchError, OutputError, Scan2AlbedoError, errors_of, needs_extra
from scan2albedo.io import limits
from scan2albedo.io.images import SUPPORTED_IMAGES, declared_pixels
from scan2albedo.io.load_scan import files_of_scan

_CAUSES = "for want of memory, or a library crashed"
_ONE_THREAD = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL", "NUMBA")}


def run_in_processes(
    tasks: Sequence[ScanTask], layout: Layout, jobs: Callable[[Sequence[ScanTask]], int]
) -> Generator[BatchScanRecord]:
    """Yield the record of each task as it is finished by local processes.

    When a worker dies, all of them do. The scans that were being processed then are tried again at the end,
    each alone, and have failed when their worker dies once more; all others go on in new processes. `jobs`
    returns how many processes to use for the tasks that are left. Raises `BatchError` when processes die
    again and again before they begin a scan.
    """
    waiting = {task.name: task for task in tasks}
    suspects: list[ScanTask] = []
    deaths = 0
    while waiting:
        left = list(waiting.values())
        try:
            for row in _processed(left, jobs(left)):
                del waiting[row.name]
                yield row
            break
        except BrokenProcessPool as error:
            ended = _ended(left, layout)
            died = [name for name, row in ended.items() if row is None]
            suspects += [waiting[name] for name in died if name in waiting]
            deaths = 0 if ended else deaths + 1
            if deaths == 3:
                raise BatchError(
                    f"worker processes die before they begin a scan ({_exit_codes(error)}); process one scan "
                    "with `scan2albedo process`, or see `scan2albedo doctor`"
                ) from error
        for name, found in ended.items():
            if waiting.pop(name, None) is not None and found is not None:
                yield found
    for task in suspects:
        try:
            yield from _processed([task], 1)
        except BrokenProcessPool as error:
            reason = f"its worker died twice ({_exit_codes(error)}): {_CAUSES}"
            yield _ended([task], layout).get(task.name) or _failed(task, layout, reason)


def _ended(tasks: Sequence[ScanTask], layout: Layout) -> dict[str, BatchScanRecord | None]:
    """Return the records of tasks that ended without an answer; None for those in progress."""
    ended: dict[str, BatchScanRecord | None] = {}
    late: dict[str, BatchScanRecord | None] = {}
    for task in tasks:
        row, begun = layout.row(task.name), layout.started_at(task.name)
        layout.unmark(task.name)
        if row is not None and row.run == task.run:
            ended[task.name] = row
        elif begun is not None and _took_too_long(task, begun):
            late[task.name] = _failed(task, layout, f"took longer than {task.timeout_s:g} s (--timeout)")
        elif begun is not None:
            ended[task.name] = None
    if late:  # they ended their workers: others in progress are not at fault
        ended = {name: row for name, row in ended.items() if row is not None}
    return ended | late


def _took_too_long(task: ScanTask, begun: float) -> bool:
    return task.timeout_s is not None and time.time() - begun >= task.timeout_s


def _processed(tasks: Sequence[ScanTask], jobs: int) -> Iterator[BatchScanRecord]:
    """Yield the records of tasks as local processes finish them; BrokenProcessPool when a process dies."""
    from loky import ProcessPoolExecutor

    executor = ProcessPoolExecutor(
        jobs, env=_ONE_THREAD, initializer=worker.begin_worker, initargs=(os.getpid(),)
    )
    tasks_left = iter(tasks)
    # Two a process: one that waits keeps a process busy, and few are lost track of when one dies.
    ahead = 1 if jobs == 1 else 2 * jobs
    running: dict[Future[BatchScanRecord], ScanTask] = {}
    with warnings.catch_warnings():
        # loky replaces a worker whose memory grew, which is intended.
        warnings.filterwarnings("ignore", "A worker stopped while some jobs", UserWarning)
        try:
            while True:
                new = islice(tasks_left, ahead - len(running))
                running |= {executor.submit(worker.process_task, task): task for task in new}
                if not running:
                    break
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    task = running.pop(future)
                    try:
                        row = future.result()
                    except (BrokenProcessPool, OutputError):
                        raise
                    # Raises whatever the task raised in its worker, of any library.
                    except Exception as error:  # noqa: BLE001
                        row = task.record("failed", _reason(error))
                    yield row
        finally:
            # At once: they hold hundreds of MB each.
            executor.shutdown(kill_workers=True)


def run_on_cluster(
    tasks: Sequence[ScanTask], layout: Layout, address: str, on_jobs: Callable[[int], None]
) -> Generator[BatchScanRecord]:
    """Yield the record of each task as it is finished by the workers of a dask scheduler.

    A scan whose worker dies is given to others as often as the scheduler allows, and has failed then, as has
    one that raises in its worker. `on_jobs` is called with the number of workers. Raises
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
        waiting = list(tasks)
        while waiting:
            again: list[ScanTask] = []
            ended: queue.SimpleQueue[tuple[ScanTask, Any]] = queue.SimpleQueue()
            futures = []  # dask forgets tasks whose futures nobody holds
            for task in waiting:
                key = f"{task.name}-{secrets.token_hex(8)}"
                futures.append(client.submit(worker.process_task, task, key=key, pure=False))
                futures[-1].add_done_callback(lambda future, task=task, put=ended.put: put((task, future)))
            for _ in futures:
                task, future = ended.get()  # also of one that dask gave up, or whose result it lost
                try:
                    row = future.result()
                # Raises whatever the task raised in its worker, of any library, and dask's own errors.
                except Exception as error:
                    if future.status != "error":  # its task did not end: nobody is there to run it
                        raise BatchError(
                            f"the dask scheduler at {address} is gone; --resume goes on with another"
                        ) from error
                    reason = _reason(error)
                    if reason.startswith("KilledWorker"):
                        begun = layout.started_at(task.name)
                        if begun is None:  # it only waited at workers that died, which the scheduler counts
                            again.append(task)
                            continue
                        late = "; it takes longer than --timeout" if _took_too_long(task, begun) else ""
                        reason = f"its workers died each time it was tried: {_CAUSES}{late} ({reason})"
                    row = _failed(task, layout, reason)
                yield row
            if len(again) == len(waiting):
                raise BatchError(f"the workers of {address} die before they begin a scan; see their logs")
            waiting = again


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
    running_mb: float = 0.0,
    textures: str | Path | None = None,
    template: int = 0,
) -> float:
    """Return the expected peak of a worker with the largest scan.

    `size` is the geometry images' side, `running_mb` a worker's measured peak, `textures` as in `load_scan`,
    `template` the side of a template's texture, whose colours, normals and marks are kept at once. An idle
    worker has 450 MB; a pixel of a picture takes 160 bytes, a byte of a mesh's file 25, a texel 400.
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
    return max(450.0 + (texels + largest) / MB, running_mb)


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
