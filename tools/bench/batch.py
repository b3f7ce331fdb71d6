"""A batch of synthetic raw scans, some of them broken: throughput, scaling, memory, and a kill in the middle.

Commands run as a user runs them. Rates count wall-clock time, so other work on the machine lowers them; CPU
seconds stand beside them. "steady s" are between two scans that end, once every process has ended its first.
`broken` holds what became of spoilt scans against what is expected: without its texture a face has a shape,
but no albedo. `killed` ends a batch with SIGKILL when half is done, and resumes it: finished files stay.
"""

import csv
import hashlib
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from worlds.files import write_obj

import scan2albedo as s2a
from bench.runner import Bench, Case, Timed
from scan2albedo.batch.records import Layout
from scan2albedo.synthetic import Scanner, raw_scan

COMMAND = [sys.executable, "-m", "scan2albedo", "batch"]
POLL_S = 0.2
SCANS = 200
SUBSET = 20
"""Scans of the runs with one job, and of the kill."""
QUICK_SCANS = 3


def truncated(good: Path, path: Path) -> None:
    text = good.read_text()
    # Before the first face: a file cut behind one may look whole (what is lost then shows in `notes`).
    path.write_text(text[: text.index("\nf ") + 1])


def with_nan(good: Path, path: Path) -> None:
    lines = good.read_text().splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith("v "))
    lines[first : first + 2000] = ["v nan nan nan"] * 2000
    path.write_text("\n".join(lines))


def without_face(good: Path, path: Path) -> None:
    import trimesh

    trimesh.creation.icosphere(5, 90.0).export(path, include_texture=False)


def without_texture(good: Path, path: Path) -> None:
    path.write_text(good.read_text().replace(good.stem, path.stem))
    path.with_suffix(".mtl").write_text("newmtl skin\nmap_Kd lost.png\n")


def empty(good: Path, path: Path) -> None:
    path.write_bytes(b"")


BROKEN: dict[str, tuple[Callable[[Path, Path], None], str]] = {
    "truncated": (truncated, "failed"),
    "nan": (with_nan, "failed"),
    "no_face": (without_face, "failed"),
    "no_texture": (without_texture, "done"),
    "empty": (empty, "failed"),
}
"""How a scan is spoilt, and what is expected of it."""


@cache
def temporary() -> tempfile.TemporaryDirectory[str]:
    """Return a folder that lives as long as the bench."""
    return tempfile.TemporaryDirectory(prefix="batch")


def folder() -> Path:
    return Path(temporary().name)


@cache
def good_scans(count: int) -> list[Path]:
    """Return scans of different people."""
    files = [folder() / f"person-{seed:04d}.obj" for seed in range(count)]
    for seed, file in enumerate(files):
        if not file.exists():
            write_obj(raw_scan(seed, scanner=Scanner(size=64, picture_size=500))[0], file)
    return files


@cache
def broken_scans() -> list[Path]:
    (good,) = good_scans(1)
    files = [folder() / f"broken-{kind}.obj" for kind in BROKEN]
    for (spoil, _), file in zip(BROKEN.values(), files, strict=True):
        spoil(good, file)
    return files


def manifest(name: str, files: list[Path]) -> Path:
    path = folder() / f"{name}.csv"
    rows = [("scan", "person"), *((file.name, file.stem) for file in files)]
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows(rows)
    return path


@dataclass(frozen=True)
class Batch:
    """Scans of a batch and its options; killed in the middle and resumed where asked for."""

    name: str
    files: list[Path]
    jobs: int
    options: tuple[str, ...] = ()
    killed: bool = False


@dataclass(frozen=True)
class Outcome:
    """JSON summary and catalogue of a command; finished files that a resumed one changed."""

    summary: dict[str, Any]
    rows: list[dict[str, Any]]
    changed: int | None = None


def run(batch: Batch) -> Timed:
    """Run the command; its CPU seconds are those of the scans."""
    listed = manifest(batch.name, batch.files)
    out = folder() / batch.name
    command = [*COMMAND, str(listed), "-o", str(out), "--jobs", str(batch.jobs), *batch.options]
    before: dict[Path, tuple[str, int]] = {}
    if batch.killed:
        before = state(out, killed_in_the_middle(command, Layout(out).rows, len(batch.files) // 2))
        command.append("--resume")
    ended = subprocess.run([*command, "--json"], capture_output=True, text=True, check=False)
    if not ended.stdout:
        raise s2a.ScanError(f"the batch ended with {ended.returncode}: {ended.stderr}")
    rows = s2a.batch.load_catalogue(out).to_pylist()
    after = state(out, sorted({path.parent.name for path in before}))
    changed = sum(after.get(path) != was for path, was in before.items())
    changes = changed if batch.killed else None
    return Timed(Outcome(json.loads(ended.stdout), rows, changes), np.nan)


def killed_in_the_middle(command: list[str], rows: Path, wanted: int) -> list[str]:
    """Start a batch, kill it with SIGKILL when so many scans are done, and return their names."""
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    while len(list(rows.glob("*.json"))) < wanted and process.poll() is None:
        time.sleep(POLL_S)
    process.kill()
    process.wait()
    # Workers end with their parent.
    time.sleep(1.0)
    return sorted(path.stem for path in rows.glob("*.json"))


def state(out: Path, names: list[str]) -> dict[Path, tuple[str, int]]:
    """Return the hash and the time of every file of the given scans."""
    files = [path for name in names for path in (out / name).iterdir()]
    return {p: (hashlib.sha256(p.read_bytes()).hexdigest(), p.stat().st_mtime_ns) for p in files}


def figures(batch: Batch, outcome: Outcome) -> dict[str, float]:
    done = [row for row in outcome.rows if row["status"] == "done"]
    ends = sorted(row["finished_at"].timestamp() for row in done)
    new = outcome.summary["done"] - outcome.summary["kept"]
    row = {
        "done": float(outcome.summary["done"]),
        "done an hour": 3600 * new / outcome.summary["seconds"],
        "CPU s a scan": float(np.median([row["cpu_seconds"] for row in done])),
        "worker MB": max(row["peak_memory_mb"] for row in done),
    }
    if len(ends) > batch.jobs:
        row["steady s"] = (ends[-1] - ends[batch.jobs - 1]) / (len(ends) - batch.jobs)
    return row if outcome.changed is None else row | {"changed": float(outcome.changed)}


def batches(quick: bool) -> Iterator[Case]:
    options = ("--size", "64" if quick else "512")
    few = QUICK_SCANS if quick else SUBSET
    whole = QUICK_SCANS if quick else SCANS

    def batch(name: str, count: int, jobs: int, *more: str, killed: bool = False) -> Batch:
        return Batch(name, good_scans(count), jobs, (*options, *more), killed)

    yield Case("two jobs", partial(batch, "two_jobs", whole, 2))
    yield Case("one job", partial(batch, "one_job", few, 1))
    yield Case("one job, no pictures", partial(batch, "no_pictures", few, 1, "--no-pictures"))
    yield Case("killed and resumed", partial(batch, "killed", few, 2, killed=True))


def broken_batch(quick: bool) -> Iterator[Case]:
    yield Case("broken", lambda: Batch("broken", broken_scans(), 2, ("--size", "64")))


def as_expected(batch: Batch, outcome: Outcome) -> dict[str, float | str]:
    ended = {row["name"].removeprefix("broken-"): row["status"] for row in outcome.rows}
    wrong = [kind for kind, (_, expected) in BROKEN.items() if ended.get(kind) != expected]
    return {"as expected": float(len(BROKEN) - len(wrong)), "others": ", ".join(wrong)}


OURS = {"scan2albedo batch": run}
BENCHES = {
    "runs": Bench(batches, OURS, figures, summaries=()),
    "broken": Bench(broken_batch, OURS, as_expected, summaries=("mean",)),
}
