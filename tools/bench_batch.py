"""A batch of synthetic raw scans, some of them broken: throughput, scaling, memory, and a kill in the middle.

    python tools/bench_batch.py [--scans 200] [--jobs 2] [--subset 20] [--size 512] [--out FOLDER]

Scans are made once and kept in FOLDER/scans; results are made anew. Commands run as a user runs them.
Rates count wall-clock time, so other work on the machine lowers them; CPU seconds stand beside them.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from loky import ProcessPoolExecutor
from worlds.files import write_obj

import scan2albedo as s2a
from scan2albedo.batch.records import Layout
from scan2albedo.synthetic import Scanner, raw_scan

COMMAND = [sys.executable, "-m", "scan2albedo", "batch"]
POLL_S = 0.2


def make_scan(path: Path, seed: int) -> float:
    """Write the scan of another person than those of other seeds; return the CPU seconds it took."""
    start = time.process_time()
    if not path.exists():
        scan, _ = raw_scan(seed, scanner=Scanner(size=64, picture_size=500))
        unfinished = path.with_name(f"unfinished-{path.name}")
        write_obj(scan, unfinished)
        for extension in (".png", ".mtl", ".obj"):  # the OBJ last: with it the scan is whole
            text = unfinished.with_suffix(extension)
            if extension != ".png":
                text.write_text(text.read_text().replace(unfinished.stem, path.stem))
            text.rename(path.with_suffix(extension))
    return time.process_time() - start


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

    ball = trimesh.creation.icosphere(5, 90.0)
    ball.export(path, include_texture=False)


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
"""How a scan is spoilt, and what is expected of it: without its texture a face has a shape, but no albedo."""


def make_scans(folder: Path, count: int, jobs: int) -> Path:
    """Write good scans, broken ones among them, and their manifest."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"person-{seed:04d}.obj" for seed in range(count)]
    with ProcessPoolExecutor(jobs, env={"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}) as processes:
        made = list(processes.map(make_scan, paths, range(count)))
    print(f"{count} scans: {np.median(made):.1f} s CPU each to make (median; 0 where kept)")
    rows = [(path.name, f"p{i:04d}", "good") for i, path in enumerate(paths)]
    for i, (kind, (spoil, _)) in enumerate(BROKEN.items()):
        spoil(paths[0], folder / f"broken-{kind}.obj")
        rows.insert((i + 1) * len(rows) // (len(BROKEN) + 1), (f"broken-{kind}.obj", "", kind))
    return write_manifest(folder / "manifest.csv", rows)


def write_manifest(path: Path, rows: list[tuple[str, str, str]]) -> Path:
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([("scan", "person", "kind"), *rows])
    return path


def subset(manifest: Path, count: int) -> Path:
    """Write a manifest of the first good scans."""
    with manifest.open(newline="", encoding="utf-8") as file:
        rows = [tuple(row) for row in csv.reader(file)][1:]
    good = [row for row in rows if row[2] == "good"][:count]
    return write_manifest(manifest.with_name("subset.csv"), good)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Outcome:
    """Of one command: its exit status, JSON summary, lines and catalogue."""

    status: int
    summary: dict[str, Any]
    lines: list[str]
    rows: list[dict[str, Any]]

    @property
    def done_per_hour(self) -> float:
        return 3600 * (self.summary["done"] - self.summary["kept"]) / self.summary["seconds"]

    def steady_s(self, jobs: int) -> float:
        """Return the seconds between two scans that end, once every process has ended its first."""
        ends = sorted(row["finished_at"].timestamp() for row in self.rows if row["status"] == "done")
        return float((ends[-1] - ends[jobs - 1]) / (len(ends) - jobs))

    def show(self, title: str) -> None:
        done = [row for row in self.rows if row["status"] == "done"]
        cpu = float(np.median([row["cpu_seconds"] for row in done])) if done else float("nan")
        peak = max((row["peak_memory_mb"] for row in done), default=float("nan"))
        print(f"\n{title}: exit status {self.status}")
        for line in self.lines:
            print(f"    {line}")
        print(
            f"  {self.done_per_hour:.0f} done an hour; {cpu:.1f} s CPU a scan (median), "
            f"{peak:.0f} MB peak of a worker"
        )


def run(manifest: Path, out: Path, *arguments: str) -> Outcome:
    """Run the command to its end."""
    ended = subprocess.run(
        [*COMMAND, manifest, "-o", out, "--json", *arguments], capture_output=True, text=True, check=False
    )
    if not ended.stdout:
        raise SystemExit(f"the batch ended with {ended.returncode}: {ended.stderr}")
    lines = [line for line in ended.stderr.splitlines() if not line.endswith("left")]
    rows = s2a.batch.load_catalogue(out).to_pylist()
    return Outcome(ended.returncode, json.loads(ended.stdout), lines, rows)


def check_broken(rows: list[dict[str, Any]]) -> None:
    """Print what became of the broken scans, and whether that was expected."""
    for row in rows:
        if row["kind"] in BROKEN:
            expected = BROKEN[row["kind"]][1]
            verdict = "as expected" if row["status"] == expected else f"EXPECTED {expected}"
            told = row["reason"] or ("with albedo" if row["path_albedo_exr"] else "without albedo")
            print(f"  {row['kind']:12}{row['status']:8}{verdict}: {told[:110]}")


def state(out: Path, names: list[str]) -> dict[Path, tuple[str, int]]:
    """Return the hash and the time of every file of the given scans."""
    files = [path for name in names for path in (out / name).iterdir()]
    return {p: (hashlib.sha256(p.read_bytes()).hexdigest(), p.stat().st_mtime_ns) for p in files}


def kill_and_resume(manifest: Path, out: Path, arguments: list[str]) -> None:
    """Kill a batch with SIGKILL when half is done, resume it, and print whether what was done stayed."""
    rows = Layout(out).rows
    wanted = len(manifest.read_text().splitlines()) // 2
    process = subprocess.Popen([*COMMAND, manifest, "-o", out, *arguments], stderr=subprocess.DEVNULL)
    while len(list(rows.glob("*.json"))) < wanted and process.poll() is None:
        time.sleep(POLL_S)
    process.kill()
    process.wait()
    time.sleep(1.0)  # workers end with their parent
    finished = sorted(path.stem for path in rows.glob("*.json"))
    before = state(out, finished)
    resumed = run(manifest, out, "--resume", *arguments)
    resumed.show(f"killed (SIGKILL) with {len(finished)} done, then --resume")
    same = state(out, finished) == before
    print(f"  {len(before)} files of {len(finished)} finished scans: {'untouched' if same else 'CHANGED'}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scans", type=int, default=200)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--subset", type=int, default=20, help="scans for one job, and for the kill")
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--out", type=Path, help="kept afterwards; a folder that is gone when omitted")
    arguments = parser.parse_args()
    folder = arguments.out or Path(tempfile.mkdtemp())
    try:
        bench(folder, arguments)
    finally:
        if arguments.out is None:
            shutil.rmtree(folder, ignore_errors=True)


def bench(folder: Path, arguments: argparse.Namespace) -> None:
    manifest = make_scans(folder / "scans", arguments.scans, arguments.jobs)
    few = subset(manifest, arguments.subset)
    for name in ("all", "one", "bare", "killed"):
        shutil.rmtree(folder / name, ignore_errors=True)
    options = ["--size", str(arguments.size)]
    many = [*options, "--jobs", str(arguments.jobs)]
    whole = run(manifest, folder / "all", *many)
    whole.show(f"{len(whole.rows)} scans, {arguments.jobs} jobs")
    check_broken(whole.rows)
    alone = run(few, folder / "one", *options, "--jobs", "1")
    alone.show(f"{len(alone.rows)} scans, 1 job")
    # Broken scans fail at once and would count as speed.
    ratio = whole.done_per_hour / alone.done_per_hour
    steady, alone_s = whole.steady_s(arguments.jobs), alone.steady_s(1)
    print(f"\n{arguments.jobs} jobs are {ratio:.2f} times as fast as 1, starting included;")
    print(f"once they run {alone_s / steady:.2f} times: {steady:.2f} s a scan against {alone_s:.2f} s")
    run(few, folder / "bare", *options, "--jobs", "1", "--no-pictures").show("the same without pictures")
    kill_and_resume(few, folder / "killed", many)


if __name__ == "__main__":
    main()
