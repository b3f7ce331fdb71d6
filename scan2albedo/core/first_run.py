"""The first run after an installation: helper processes compile kernels that its later stages need.

Numba compiles one kernel at a time in a process and keeps it on disk, where the run finds what helpers have
compiled meanwhile. What they have not compiled in time, it compiles itself.
"""

import contextlib
import gc
import importlib
import multiprocessing
import os
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from importlib import resources
from pathlib import Path
from subprocess import DEVNULL, PIPE, Popen
from typing import Any, NamedTuple

SWITCH = "SCAN2ALBEDO_COMPILE"
"""Environment variable that keeps helpers away where it is "serial"."""
MOST_HELPERS = 3
RECORD = "first_run_kernels.txt"
"""File beside this one that `tools/record_kernels.py` writes: module, function and signature on a line."""
_COLD = 0.25
"""Part of the kernels that must be missing on disk for helpers to be worth their start."""
_UNDER_WAY = threading.Lock()


class RecordedKernel(NamedTuple):
    """A kernel that a run calls, and the types of its arguments as numba reads them."""

    module: str
    function: str
    signature: str

    def dispatcher(self) -> Any:
        """Return the kernel, a plain function where numba is switched off; its module is loaded."""
        return getattr(importlib.import_module(self.module), self.function)

    def argument_types(self) -> tuple[Any, ...]:
        """Return numba's types: as a tuple, by which a call looks the kernel up on disk."""
        from numba.core.sigutils import normalize_signature

        return tuple(normalize_signature(self.signature)[0])


def recorded_kernels() -> tuple[RecordedKernel, ...]:
    """Return the kernels that a run calls from Python, in the order of their first calls."""
    lines = resources.files(__package__).joinpath(RECORD).read_text("utf-8").splitlines()
    return tuple(RecordedKernel(*line.split(" ", 2)) for line in lines)


@contextlib.contextmanager
def compiled_beside() -> Iterator[None]:
    """Have helpers compile during the block what is not on disk yet; they end with the block."""
    if not _UNDER_WAY.acquire(blocking=False):
        yield
        return
    helpers, thresholds = list[Popen[bytes]](), gc.get_threshold()
    try:
        count = _helper_count()
        if count and _is_cold([kernel.dispatcher() for kernel in recorded_kernels()]):
            if thresholds[0] > 0:
                # By Python's own rule garbage collections take a sixth of the time while much is compiled.
                gc.set_threshold(max(thresholds[0], 100_000), *thresholds[1:])
            helpers = _started(count)
        yield
    finally:
        gc.set_threshold(*thresholds)
        for helper in helpers:
            helper.kill()
            helper.communicate()
        _UNDER_WAY.release()


def _helper_count() -> int:
    """Return how many helpers there may be: one for each further core; none where they could do harm."""
    if os.environ.get(SWITCH) == "serial" or multiprocessing.parent_process() is not None:
        return 0
    # Programs with Python inside name themselves as the executable, and would start once more.
    if getattr(sys, "frozen", False) or not Path(sys.executable or "").stem.lower().startswith("python"):
        return 0
    affinity = getattr(os, "sched_getaffinity", None)
    cores = len(affinity(0)) if affinity is not None else os.cpu_count() or 1
    return min(cores - 1, MOST_HELPERS)


def _is_cold(kernels: Sequence[Any]) -> bool:
    """Whether many of the kernels are not on disk, and can be kept there once they are compiled."""
    missing = 0
    for kernel in kernels:
        # A plain function where numba is switched off, no path where nothing is kept.
        folder = getattr(getattr(kernel, "stats", None), "cache_path", None)
        if not folder or not os.access(folder, os.W_OK):
            return False
        source = Path(kernel.py_func.__code__.co_filename)
        kept = [*Path(folder).glob(f"{source.stem}.{kernel.py_func.__qualname__}-*.nb[ic]")]
        # Older than the source: where one process writes the index anew, another might read it by that.
        changed = source.stat().st_mtime
        old = [entry for entry in kept if entry.stat().st_mtime < changed <= time.time()]
        for entry in old:
            entry.unlink(missing_ok=True)
        missing += len(old) == len(kept)
    return missing > _COLD * len(kernels)


def _started(count: int) -> list[Popen[bytes]]:
    """Start helpers, silent and of low priority, which see the modules that this process sees."""
    helpers = list[Popen[bytes]]()
    priority = getattr(subprocess, "BELOW_NORMAL_PRIORITY_CLASS", 0)
    priority |= getattr(subprocess, "CREATE_NO_WINDOW", 0)
    path = os.pathsep.join(folder or os.getcwd() for folder in sys.path)
    env = {**os.environ, "PYTHONPATH": path, SWITCH: "serial"}
    with contextlib.suppress(OSError):
        for number in range(count):
            command = [sys.executable, "-P", "-m", __name__, str(number), str(count)]
            helpers.append(
                Popen(command, stdin=PIPE, stdout=DEVNULL, stderr=DEVNULL, env=env, creationflags=priority)
            )
    return helpers


def _help(number: int, count: int) -> None:
    """Compile every `count`-th of the recorded kernels, those that the run comes to last at the end."""

    def end_with_parent() -> None:
        with contextlib.suppress(OSError):
            os.read(0, 1)  # the pipe from the parent closes however that ends
        os._exit(0)

    threading.Thread(target=end_with_parent, daemon=True).start()
    if hasattr(os, "nice"):
        os.nice(5)
    gc.disable()
    # Where two processes keep different signatures of one function in the same moment, numba may take one for
    # the other later: those are left to the run.
    names = Counter((kernel.module, kernel.function) for kernel in recorded_kernels())
    kernels = [kernel for kernel in recorded_kernels() if names[kernel.module, kernel.function] == 1]
    # From there on a helper stays ahead of the run, which does its work besides.
    ahead = len(kernels) // (count + 2)
    for kernel in (*kernels[ahead:][number::count], *kernels[:ahead][::-1][number::count]):
        # What fails here fails in the run itself, too, if it comes to it.
        with contextlib.suppress(Exception):
            kernel.dispatcher().compile(kernel.argument_types())


if __name__ == "__main__":
    _help(int(sys.argv[1]), int(sys.argv[2]))
