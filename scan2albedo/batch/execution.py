"""Tasks through workers, whatever becomes of the workers."""

from __future__ import annotations

import re
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager

from scan2albedo.batch import worker
from scan2albedo.batch.layout import Layout
from scan2albedo.batch.records import BatchScanRecord
from scan2albedo.batch.worker import ScanTask
from scan2albedo.errors import BatchError

_DEATHS_BEFORE_ANY_SCAN = 3
_CAUSES = "for want of memory, or a library crashed"


def run_in_processes(
    tasks: Sequence[ScanTask], layout: Layout, jobs: Callable[[Sequence[ScanTask]], int]
) -> Iterator[BatchScanRecord]:
    """Yield the record of each task as it is finished by local processes.

    When a worker dies, all of them do. The scans that were being processed then are suspects: they are tried
    again at the end, each alone, and have failed when their worker dies once more; all others go on in new
    processes.

    Parameters
    ----------
    tasks : sequence of ScanTask
    layout : Layout
    jobs : callable
        Returns how many processes to use for the tasks that are left.

    Raises
    ------
    BatchError
        When processes die again and again before they begin a scan.
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
            suspects += [task for task in left if task.name in waiting and ended.get(task.name) == _DIED]
            deaths = 0 if ended else deaths + 1
            if deaths == _DEATHS_BEFORE_ANY_SCAN:
                raise BatchError(
                    f"worker processes die before they begin a scan ({_exit_codes(error)}); process one scan "
                    "with `scan2albedo process`, or see `scan2albedo doctor`"
                ) from error
        for name, found in ended.items():
            if waiting.pop(name, None) is not None and isinstance(found, BatchScanRecord):
                yield found
    for task in suspects:
        yield _alone(task, layout)


_DIED = "died"


def _ended(tasks: Sequence[ScanTask], layout: Layout) -> dict[str, BatchScanRecord | str]:
    """Return the records of tasks that ended without having told so; "died" for those under way.

    One that took too long ended its worker itself; those beside it are innocent and are left out.
    """
    ended: dict[str, BatchScanRecord | str] = {}
    late: dict[str, BatchScanRecord | str] = {}
    for task in tasks:
        row, begun = layout.row(task.name), layout.started_at(task.name)
        layout.unmark(task.name)
        if row is not None and row.run == task.run:
            ended[task.name] = row
        elif begun is not None and _took_too_long(task, begun):
            late[task.name] = _failed(task, layout, f"took longer than {task.timeout_s:g} s (--timeout)")
        elif begun is not None:
            ended[task.name] = _DIED
    if late:
        ended = {name: row for name, row in ended.items() if row != _DIED}
    return ended | late


def _took_too_long(task: ScanTask, begun: float) -> bool:
    return task.timeout_s is not None and time.time() - begun >= task.timeout_s


def _alone(task: ScanTask, layout: Layout) -> BatchScanRecord:
    try:
        (row,) = _processed([task], 1)
        return row
    except BrokenProcessPool as error:
        ended = _ended([task], layout).get(task.name)
        if isinstance(ended, BatchScanRecord):
            return ended
        return _failed(task, layout, f"its worker died twice ({_exit_codes(error)}): {_CAUSES}")


def _processed(tasks: Sequence[ScanTask], jobs: int) -> Iterator[BatchScanRecord]:
    from joblib import delayed

    from scan2albedo.batch.backends import local_processes

    with _quiet(), local_processes(jobs) as parallel:
        yield from parallel(delayed(worker.process_task)(task) for task in tasks)


def run_on_cluster(
    tasks: Sequence[ScanTask], layout: Layout, address: str, on_jobs: Callable[[int], None]
) -> Iterator[BatchScanRecord]:
    """Yield the record of each task as it is finished by the workers of a dask scheduler.

    A scan whose worker dies is given to others as often as the scheduler allows, and has failed then. The
    scheduler blames scans that waited at such workers too; those that were never begun are tried again.
    `on_jobs` is called with the number of workers.

    Raises
    ------
    MissingDependencyError
        When distributed is not installed.
    BatchError
        When no scheduler or no worker answers, or the scheduler is lost.
    """
    from joblib import delayed

    from scan2albedo.batch.backends import cluster

    def died(task: ScanTask, reason: str) -> BatchScanRecord | ScanTask | None:
        if not reason.startswith("KilledWorker"):
            return None
        begun = layout.started_at(task.name)
        if begun is None:
            return task
        late = "; it takes longer than --timeout" if _took_too_long(task, begun) else ""
        return _failed(task, layout, f"its workers died each time it was tried: {_CAUSES}{late} ({reason})")

    waiting = list(tasks)
    while waiting:
        again: list[ScanTask] = []
        with _quiet(), cluster(address, died) as (parallel, workers):
            on_jobs(workers)
            for ended in parallel(delayed(worker.process_task)(task) for task in waiting):
                if isinstance(ended, BatchScanRecord):
                    yield ended
                elif ended is not None:
                    again.append(ended)
                else:
                    raise BatchError(
                        f"the dask scheduler at {address} is gone; --resume goes on with another"
                    )
        if len(again) == len(waiting):
            raise BatchError(f"the workers of {address} die before they begin a scan; see their logs")
        waiting = again


def _failed(task: ScanTask, layout: Layout, reason: str) -> BatchScanRecord:
    row = task.failed(reason)
    layout.keep(row)
    return row


def _exit_codes(error: BaseException) -> str:
    found = re.search(r"\{([^}]*)\}", str(error))
    return found.group(1) if found else type(error).__name__


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep loky from warning of a worker that it replaces because its memory grew: that is wanted here."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "A worker stopped while some jobs", UserWarning)
        yield
