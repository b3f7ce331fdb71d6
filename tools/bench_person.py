"""A person from 1 to 32 scans: albedo beside that of each scan alone, run time and memory.

    python tools/bench_person.py [--people 3,4] [--counts 1,2,3,5,8,32] [--size 256] [--out FOLDER]
    python tools/bench_person.py --traced FOLDER

Synthetic scans, each with an expression, a lamp near by and a pose of its own. `scan2albedo person` runs as a
user runs it, at draft; CPU and the greatest resident memory are those of its process. Errors are relative
RMSE on the texels of skin that two scans or more show, in % of the true albedo, beside the stated one.

--traced takes the pairs of scans that `python tools/worlds FOLDER --heads HEADS` makes, and prints for each
the errors (relative RMSE of V = max(R, G, B), 100 MSE) of both scans alone, and of the common albedo on the
texels of skin of either.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from bench.judging import AlbedoScore, ScanTruth, judged_scan, score
from worlds.files import write_obj

from scan2albedo import process, process_person, read_geometry_image
from scan2albedo.albedo import albedo_error
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.io.images import read_exr_channels, read_image_linear
from scan2albedo.synthetic import Scanner, light_at, raw_scan

EXPRESSIONS = ("neutral", "smile", "frown", "surprise")


def write_scans(folder: Path, seed: int, count: int, size: int) -> tuple[list[Path], FloatArray]:
    """Return the files of a person's scans and the true albedo (H, W, 3)."""
    files, truth, rng = list[Path](), np.zeros(0), np.random.default_rng(seed)
    for k in range(count):
        lamp = light_at(*rng.uniform((-50, -10), (50, 50)), distance_mm=900.0, intensity=rng.uniform(2, 3))
        expression = EXPRESSIONS[k % len(EXPRESSIONS)]
        scan, true = raw_scan(seed, expression=expression, lights=(lamp,), scanner=Scanner(size=size))  # type: ignore[arg-type]
        files.append(folder / f"scan{k}.obj")
        write_obj(scan, files[-1])
        truth = true.albedo_linear
    return files, truth


def error_percent(folder: Path, truth: FloatArray, counted: BoolArray) -> float:
    """Return the relative RMSE of a result's albedo."""
    found = read_image_linear(folder / "albedo.exr")[counted]
    return 100 * albedo_error(found, truth[counted], np.ones(len(found), bool)).relative_rmse


def print_pairs(folder: Path) -> None:
    """Print a row a person of path-traced scans."""
    print(
        "| person | scan alone | other alone | common on its texels | on the other's | to the better alone |"
    )
    print("|---" * 6 + "|")
    files, across = sorted(folder.glob("*_*.obj")), np.abs(np.linspace(-1, 1, 256))
    # A head's photographs do not reach the rim of the chart.
    away = np.hypot(across, across[:, None]) < 0.8
    for first in files[::2]:
        person, both = first.stem.split("_")[0], [f for f in files if f.stem.startswith(first.stem[:3])]
        common = process_person(both, quality="draft", size=256).common
        assert common is not None
        alone, together = list[AlbedoScore](), list[AlbedoScore]()
        for file in both:
            result = process(file, quality="draft", size=256)
            assert result.albedo is not None
            judged = judged_scan(result, ScanTruth.read(folder, file.stem))
            assert result.geometry_image.skin is not None
            on = judged.albedo_linear, judged.judged & (result.geometry_image.skin > 0.5) & away
            alone.append(score(result.albedo.albedo_linear.astype(float), *on))
            together.append(score(common.albedo_linear.astype(float), *on))
        texts = [f"{one.rmse:.1f} %, {one.mse:.2f}" for one in (*alone, *together)]
        ratio = np.mean([one.rmse for one in together]) / min(one.rmse for one in alone)
        print(f"| {person} | {' | '.join(texts)} | {ratio:.2f} |", flush=True)


def main() -> None:
    """Print a row a person and number of scans."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--people", default="3,4")
    parser.add_argument("--counts", default="1,2,3,5,8,32")
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--traced", type=Path)
    args = parser.parse_args()
    if args.traced is not None:
        print_pairs(args.traced)
        return
    counts = [int(count) for count in args.counts.split(",")]
    print("| person | scans | alone: best, mean | of all | stated | CPU s | peak MB |\n" + "|---" * 7 + "|")
    with tempfile.TemporaryDirectory() as temporary:
        for seed in map(int, args.people.split(",")):
            folder = (args.out or Path(temporary)) / f"person{seed}"
            folder.mkdir(parents=True, exist_ok=True)
            files, truth = write_scans(folder, seed, max(counts), args.size)
            for count in counts:
                command = [
                    sys.executable,
                    "-m",
                    "scan2albedo",
                    "person",
                    f"of{count}",
                    *files[:count],
                    "-o",
                    folder,
                ]
                more = ["--quality", "draft", "--size", args.size, "--no-pictures"]
                process = subprocess.Popen(list(map(str, command + more)), stderr=subprocess.PIPE, text=True)
                assert process.stderr is not None
                said = process.stderr.read()
                _, status, used = os.wait4(process.pid, 0)
                if os.waitstatus_to_exitcode(status) == 2:
                    raise SystemExit(said)
                result = folder / f"of{count}"
                seen = read_image_linear(result / "coverage.png")[..., 0] > 0
                image = read_geometry_image(result / "geometry_image.npz")
                assert image.skin is not None
                counted = seen & (image.skin > 0.5) & (truth.max(-1) > 0)
                alone = [error_percent(result / f"scan{k}", truth, counted) for k in range(count)]
                stated = read_exr_channels(result / "expected_error.exr")
                print(
                    f"| {seed} | {count} | {min(alone):.2f} %, {np.mean(alone):.2f} "
                    f"| {error_percent(result, truth, counted):.2f} % "
                    f"| {100 * np.median(next(iter(stated.values()))[counted]):.1f} % "
                    f"| {used.ru_utime + used.ru_stime:.0f} | {used.ru_maxrss / 1024:.0f} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
