"""joblib's backends, so that a worker that dies costs one scan and not the batch."""

from __future__ import annotations

import os
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import joblib
from joblib._parallel_backends import LokyBackend
from joblib.executor import get_memmapping_executor

from scan2albedo.batch.worker import begin_worker
from scan2albedo.errors import BatchError, MissingDependencyError

_CONNECT_S = 15
_IDLE_S = 600


class OwnProcesses(LokyBackend):
    """loky that works in a process of its own even for one job, where joblib would use the caller's.

    Parameters
    ----------
    processes : int
    """

    def __init__(self, processes: int = 1, **options: Any) -> None:
        super().__init__(**options)
        self._processes = processes
        self.inner_max_num_threads = 1

    def configure(self, n_jobs: int = 1, parallel: Any = None, **options: Any) -> int:
        """Start the processes; joblib is told of two at least, else it would use none."""
        self._workers = get_memmapping_executor(
            self._processes,
            timeout=_IDLE_S,
            env=self._prepare_worker_env(n_jobs=self._processes),
            context_id=parallel._id,
            initializer=begin_worker,
            initargs=(os.getpid(),),
            max_nbytes=None,
        )
        self.parallel = parallel
        return max(self._processes, 2)

    def terminate(self) -> None:
        """End the processes, which hold hundreds of MB each."""
        if self._workers is not None:
            self._workers.terminate(kill_workers=True)
            self._workers = None
        self.reset_batch_stats()


@contextmanager
def local_processes(count: int) -> Iterator[joblib.Parallel]:
    """Give a `Parallel` of so many local processes."""
    with joblib.parallel_config(backend=OwnProcesses(count), n_jobs=count):
        ahead = 1 if count == 1 else 2 * count
        yield joblib.Parallel(return_as="generator_unordered", batch_size=1, pre_dispatch=ahead)


@contextmanager
def cluster(address: str, died: Callable[[Any, str], Any]) -> Iterator[tuple[joblib.Parallel, int]]:
    """Give a `Parallel` of the workers of a dask scheduler, and their number.

    Parameters
    ----------
    address : str
        Such as "tcp://10.0.0.5:8786".
    died : callable
        Returns the result of a task whose workers died, from the task and the reason.

    Raises
    ------
    MissingDependencyError
        When distributed is not installed.
    BatchError
        When no scheduler or no worker answers.
    """
    try:
        from distributed import Client
        from joblib._dask import DaskDistributedBackend
    except ImportError as error:
        raise MissingDependencyError(
            "--scheduler needs dask: pip install 'scan2albedo[cluster]' (here and on the workers)"
        ) from error

    class SurvivingDask(DaskDistributedBackend):
        """joblib's dask backend, with every end of a task told.

        joblib's own waits for ever when dask gives a task up, or loses its result with a worker.
        """

        def start_call(self) -> None:
            self._pending: set[Any] = set()

        def stop_call(self) -> None:
            self._pending.clear()

        def abort_everything(self, ensure_ready: bool = True) -> None:
            self._pending.clear()  # dask forgets tasks that nobody refers to

        def effective_n_jobs(self, n_jobs: int) -> int:
            # Two at least: for one worker joblib would process the scans in the caller's process.
            return max(super().effective_n_jobs(n_jobs), 2)

        def submit(self, func: Any, callback: Callable[[Any], None]) -> Any:
            ((work, (task,), _),) = func.items
            future = self.client.submit(work, task, key=f"{task.name}-{secrets.token_hex(8)}", pure=False)
            self._pending.add(future)

            def tell(ended: Any) -> None:
                self._pending.discard(ended)
                try:
                    result = ended.result()
                except Exception as error:  # noqa: BLE001  whatever it is, the scan has ended by it
                    result = died(task, _reason(error))
                callback(result)

            future.add_done_callback(tell)
            return future

        def retrieve_result_callback(self, out: Any) -> list[Any]:
            return [out]

    try:
        client = Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise BatchError(f"no dask scheduler answers at {address} ({error}); check the address") from error
    with client:
        workers = len(client.nthreads())
        if not workers:
            raise BatchError(
                f"the dask scheduler at {address} has no worker; start one: dask worker {address}"
            )
        with joblib.parallel_config(backend=SurvivingDask(client=client)):
            yield joblib.Parallel(return_as="generator_unordered", batch_size=1, pre_dispatch="all"), workers


def _reason(error: BaseException) -> str:
    first = (str(error).strip().splitlines() or [""])[0]
    return f"{type(error).__name__}: {first}"
