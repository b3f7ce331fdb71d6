"""CPU and wall seconds and peak memory of each stage on one scan.

    python tools/bench_pipeline.py [SCAN] [--size 512]
    python tools/bench_pipeline.py [SCAN] --first

Each stage runs once to warm up compiled code and caches, then once measured. Without SCAN, the real scan
beside the repository is used, or the built-in synthetic one where that is absent. `--first` measures the
first run after an installation instead: everything with all files, by a new process without compiled kernels,
alone, with helpers beside it, and once more with the kernels that it left.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import scan2albedo as s2a
from scan2albedo.core.first_run import SWITCH

FIRST = """
import sys
import time

begin = time.perf_counter()
import scan2albedo as s2a

s2a.process(sys.argv[1], out=sys.argv[2])
print(time.perf_counter() - begin)
"""
REAL_SCAN = Path(__file__).resolve().parents[1].parent / "shared" / "data" / "james.obj"


@dataclass
class Row:
    stage: str
    wall_s: float
    cpu_s: float
    peak_mb: float


def peak_memory_mb() -> float:
    """Highest resident memory since the last reset, from the kernel's own book-keeping."""
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1024


def reset_peak_memory() -> None:
    Path("/proc/self/clear_refs").write_text("5")


def measured(rows: list[Row], stage: str, work: Callable[[], Any]) -> Any:
    work()
    reset_peak_memory()
    wall, cpu = time.perf_counter(), time.process_time()
    value = work()
    rows.append(Row(stage, time.perf_counter() - wall, time.process_time() - cpu, peak_memory_mb()))
    return value


def run(source: Path | None, size: int) -> list[Row]:
    rows: list[Row] = []
    if source is None:
        scan = measured(rows, "make the scan", lambda: s2a.synthetic.raw_scan(0)[0])
    else:
        scan = measured(rows, "load", lambda: s2a.load_scan(source))
    model = s2a.AnnotatedFaceModel.default()
    registration = measured(rows, "register", lambda: s2a.register(scan, model))
    fitted = measured(rows, "fit", lambda: s2a.fit(scan, model, registration))
    image = measured(rows, "geometry image", lambda: s2a.geometry_image(fitted, scan, size))
    measured(rows, "light and albedo", lambda: s2a.estimate_albedo(image))
    with tempfile.TemporaryDirectory() as out:
        measured(rows, "whole run with files", lambda: s2a.process(source or scan, out, size=size))
    return rows


def first_run(source: Path, cache: str, alone: bool) -> float:
    """Return the wall seconds of `process` in a new process that keeps its kernels in `cache`."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": cache, SWITCH: "serial" if alone else ""}
    with tempfile.TemporaryDirectory() as out:
        done = subprocess.run(
            [sys.executable, "-c", FIRST, source, out],
            env=environment,
            stdout=subprocess.PIPE,
            text=True,
            check=True,
        )
    return float(done.stdout)


def report_first_runs(source: Path) -> None:
    """Print how long a first run takes alone and with helpers, and how long one that finds its kernels."""
    with tempfile.TemporaryDirectory() as cache, tempfile.TemporaryDirectory() as other:
        print(f"first run alone                {first_run(source, cache, alone=True):6.1f} s wall")
        print(f"first run, helpers beside it   {first_run(source, other, alone=False):6.1f} s wall")
        print(f"next run, by a new process     {first_run(source, other, alone=True):6.1f} s wall")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scan", nargs="?", type=Path, default=REAL_SCAN if REAL_SCAN.is_file() else None)
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--first", action="store_true")
    arguments = parser.parse_args()
    if arguments.first and arguments.scan is None:
        parser.error("name a scan: the real one is not beside the repository")
    if arguments.first:
        report_first_runs(arguments.scan)
        return
    print(f"scan {arguments.scan or 'synthetic'}, geometry image {arguments.size} x {arguments.size}")
    print(f"{'stage':24}{'wall s':>9}{'CPU s':>9}{'peak MB':>10}")
    for row in run(arguments.scan, arguments.size):
        print(f"{row.stage:24}{row.wall_s:9.2f}{row.cpu_s:9.2f}{row.peak_mb:10.0f}")


if __name__ == "__main__":
    main()
