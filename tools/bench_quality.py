"""Error and CPU seconds of the whole pipeline: by preset, and by budgets in seconds.

    python tools/bench_quality.py presets [--seeds 6]
    python tools/bench_quality.py budgets [--seeds 3] [--quality standard]

Scans are synthetic people scanned with one or two flashes; files are not written and a first scan warms up.
Errors are of the surface where skin was scanned (not under hair), of dense correspondence there, of 51
landmarks, and of the albedo on its own texels. Budgets are tried as shares of what a run without one takes.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace

import numpy as np
from worlds.synthetic_scans import scanned_skin

import scan2albedo as s2a
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.rigid import invert_rigid, transform_points
from scan2albedo.pipeline.demo import compare_with_truth
from scan2albedo.pipeline.options import PRESETS
from scan2albedo.synthetic import Scanner, SyntheticTruth, raw_scan

WARM_UP_SEED = 99
FIGURES = ("surface mm", "correspondence mm", "landmarks mm", "albedo RMSE %", "albedo MSE %", "light deg")
BUDGET_SHARES = (0.01, 0.25, 0.5, 0.75, 1.0, 1.5)


@dataclass(frozen=True)
class Run:
    """What one run took, and its errors in the order of `FIGURES`."""

    wall_s: float
    cpu_s: float
    errors: tuple[float, ...]


def scene(seed: int, size: int) -> tuple[s2a.RawScan, SyntheticTruth]:
    return raw_scan(seed, scanner=Scanner(size=size))


def measured(
    scan: s2a.RawScan, truth: SyntheticTruth, quality: s2a.Quality, budget: float | None = None
) -> Run:
    wall, cpu = time.perf_counter(), time.process_time()
    result = s2a.process(scan, quality=quality, budget=budget)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    report = compare_with_truth(result, truth)
    errors = (
        *scanned_skin_mm(result, scan, truth),
        report.landmarks_mm,
        100 * report.albedo.relative_rmse,
        report.albedo.mse_percent,
        report.light_deg,
    )
    return Run(wall, cpu, errors)


def scanned_skin_mm(
    result: s2a.ProcessResult, scan: s2a.RawScan, truth: SyntheticTruth
) -> tuple[float, float]:
    """Return mean surface and correspondence error over the true texels that were scanned."""
    fitted, image = result.fitted, result.geometry_image
    assert fitted is not None
    truth_from_fit = truth.model_from_scan @ invert_rigid(fitted.model_from_scan)
    both = image.mask & truth.image.mask
    true = truth.image.position[both]
    skin = scanned_skin(scan, truth, true)
    surface = ClosestPointQuery(transform_points(truth_from_fit, fitted.vertices), fitted.faces)
    apart = np.linalg.norm(transform_points(truth_from_fit, image.position[both]) - true, axis=1)
    return float(surface.query(true).distance[skin].mean()), float(apart[skin].mean())


def presets(seeds: int) -> None:
    print(f"{'preset':10}{'texels':>7}{'CPU s':>8}" + "".join(f"{name:>19}" for name in FIGURES))
    for quality in PRESETS.values():
        measured(*scene(WARM_UP_SEED, quality.size), quality)
        runs = [measured(*scene(seed, quality.size), quality) for seed in range(seeds)]
        errors = np.array([run.errors for run in runs])
        cells = [f"{m:.3f} ({w:.3f})" for m, w in zip(errors.mean(0), errors.max(0), strict=True)]
        cpu = np.mean([run.cpu_s for run in runs])
        print(
            f"{quality.name:10}{quality.size:7d}{cpu:8.2f}" + "".join(f"{cell:>19}" for cell in cells),
            flush=True,
        )
    print("mean (worst) of", seeds, "scans")


def budgets(seeds: int, quality: s2a.Quality) -> None:
    measured(*scene(WARM_UP_SEED, quality.size), quality)
    print(f"{'seed':5}{'budget s':>9}{'wall s':>8}{'over s':>8}" + "".join(f"{name:>19}" for name in FIGURES))
    for seed in range(seeds):
        scan, truth = scene(seed, quality.size)
        free = measured(scan, truth, quality)
        limits = [share * free.wall_s for share in BUDGET_SHARES]
        rows = [(limit, measured(scan, truth, quality, limit)) for limit in limits]
        for budget, run in (*rows, (None, free)):
            over = "" if budget is None else f"{run.wall_s - budget:8.2f}"
            named = "none" if budget is None else f"{budget:.2f}"
            cells = "".join(f"{error:19.3f}" for error in run.errors)
            print(f"{seed:<5}{named:>9}{run.wall_s:8.2f}{over:>8}{cells}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("presets", "budgets"))
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--quality", choices=tuple(PRESETS), default="standard")
    parser.add_argument("--size", type=int, help="texels of every preset")
    arguments = parser.parse_args()
    if arguments.what == "presets":
        presets(arguments.seeds)
    else:
        chosen = PRESETS[arguments.quality]
        budgets(arguments.seeds, replace(chosen, size=arguments.size or chosen.size))


if __name__ == "__main__":
    main()
