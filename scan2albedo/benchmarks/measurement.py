"""What a piece of work costs: CPU seconds of all threads, and seconds on the wall."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

T = TypeVar("T")


@dataclass(frozen=True)
class Cost:
    """`cpu_s` of this process with all its threads, and `wall_s`."""

    cpu_s: float
    wall_s: float


def timed(work: Callable[[], T]) -> tuple[T, Cost]:
    """Return what `work` returns, and what it cost."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = work()
    return result, Cost(time.process_time() - cpu, time.perf_counter() - wall)
