"""What scenes do not need, the time that leaving it out saves, and what it costs in error.

    python tools/bench_left_out.py [--size 256] [--seeds 2]

Every scene is processed twice: as the evidence decides, and with every optional step forced. Errors are of
the albedo (relative RMSE in percent after the best single scale); "change" is what the plan adds to the
forced error (negative: leaving out is better). CPU seconds of warm code, best of `REPEATS`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import scan2albedo as s2a
from scan2albedo.albedo import OPTIONAL_STEPS, EstimateOptions
from scan2albedo.core import Plan
from scan2albedo.pipeline.demo import compare_with_truth
from scan2albedo.pipeline.options import STEPS
from scan2albedo.synthetic import Material, Scanner, face, hemisphere, light_at, raw_scan
from scan2albedo.synthetic.scenes import SyntheticScene

REPEATS = 2
GLOSSY = Material(sigma_rad=0.3, specular_strength=0.1, specular_exponent=20.0)
MATT = Material(sigma_rad=0.0)


@dataclass(frozen=True)
class Run:
    """What ran, what it took, and the albedo's error in percent, when there is an albedo."""

    plan: Plan
    cpu_s: float
    error: float | None


@dataclass(frozen=True)
class Trial:
    """A scene processed as planned and with everything forced."""

    name: str
    planned: Run
    forced: Run

    @property
    def change_percent(self) -> float | None:
        if self.planned.error is None or not self.forced.error:
            return None
        return 100 * (self.planned.error / self.forced.error - 1)


def estimated(scene: SyntheticScene, options: EstimateOptions) -> Run:
    start = time.process_time()
    estimate = s2a.estimate_albedo(scene.image, options=options)
    cpu = time.process_time() - start
    error = s2a.albedo_error(estimate.albedo_linear, scene.albedo_linear, scene.image.seen).relative_rmse
    return Run(estimate.plan, cpu, 100 * error)


def processed(scan: s2a.RawScan, truth: object, size: int, force: tuple[str, ...], model: str | None) -> Run:
    start = time.process_time()
    result = s2a.process(scan, size=size, model=model, force=force)
    cpu = time.process_time() - start
    comparable = truth is not None and result.albedo is not None and result.fitted is not None
    error = 100 * compare_with_truth(result, truth).albedo.relative_rmse if comparable else None
    return Run(result.plan, cpu, error)


def best(run: Callable[[], Run]) -> Run:
    """Return the quickest of some runs."""
    return min((run() for _ in range(REPEATS)), key=lambda done: done.cpu_s)


def light_scenes(size: int, seed: int) -> Iterator[tuple[str, SyntheticScene]]:
    side, front = light_at(45, 15), light_at(0, 10)
    near = light_at(30, 20, distance_mm=600.0)
    yield "hemisphere, matt", hemisphere(texture="wood", size=size, lights=[side], material=MATT, seed=seed)
    yield "face, matt, from the front", face(size=size, lights=[front], material=MATT, seed=seed)
    yield "face, matt, from the side", face(size=size, lights=[side], material=MATT, seed=seed)
    yield "face, glossy", face(size=size, lights=[side], material=GLOSSY, seed=seed)
    yield "face, glossy, flash at 600 mm", face(size=size, lights=[near], material=GLOSSY, seed=seed)
    two = [light_at(-50, 10), light_at(50, 20)]
    yield "face, matt, two lights", face(size=size, lights=two, material=MATT, seed=seed)
    yield "face, overexposed", face(size=size, lights=[side], material=GLOSSY, exposure=1.8, seed=seed)
    yield "face, 1 % noise", face(size=size, lights=[side], material=MATT, noise=0.01, seed=seed)


def trials(size: int, seeds: int) -> Iterator[Trial]:
    """Yield every scene's two runs."""
    free, all_parts = EstimateOptions(), EstimateOptions(force=OPTIONAL_STEPS)
    for seed in range(seeds):
        for name, scene in light_scenes(size, seed):
            yield Trial(
                f"{name} ({seed})",
                best(lambda scene=scene: estimated(scene, free)),
                best(lambda scene=scene: estimated(scene, all_parts)),
            )
        yield from scan_trials(size, seed)


def scan_trials(size: int, seed: int) -> Iterator[Trial]:
    """Yield whole runs of `process`."""
    scan, truth = raw_scan(seed, scanner=Scanner(size=size))
    subjects = (
        ("raw scan", scan, None),
        ("raw scan without colour", replace(scan, uv=None, texture_linear=None), None),
        ("raw scan, --model none", scan, "none"),
    )
    for name, subject, model in subjects:
        planned, forced = (
            best(lambda s=subject, f=force, m=model: processed(s, truth, size, f, m)) for force in ((), STEPS)
        )
        yield Trial(f"{name} ({seed})", planned, forced)


def row(trial: Trial) -> str:
    """Return a trial as a line of the table."""
    a, b = trial.planned, trial.forced
    saved = f"{100 * (1 - a.cpu_s / b.cpu_s):6.0f}%"
    errors = "".join(f"{'-' if run.error is None else format(run.error, '.2f'):>9}" for run in (a, b))
    change = "-" if trial.change_percent is None else f"{trial.change_percent:+.1f}%"
    missing = ", ".join(step.stage for step in a.plan if not step.ran)
    return f"{trial.name:36}{a.cpu_s:7.2f}{b.cpu_s:8.2f}{saved}{errors}{change:>8}  {missing or '-'}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--seeds", type=int, default=2)
    arguments = parser.parse_args()
    s2a.estimate_albedo(hemisphere(size=64).image)
    s2a.process(raw_scan(99, scanner=Scanner(size=64))[0], size=64, force=STEPS)
    print(f"{'scene':36}{'CPU s':>7}{'forced':>8}{'saved':>7}", end="")
    print(f"{'error %':>9}{'forced':>9}{'change':>8}  left out")
    planned, forced = 0.0, 0.0
    for trial in trials(arguments.size, arguments.seeds):
        planned, forced = planned + trial.planned.cpu_s, forced + trial.forced.cpu_s
        print(row(trial), flush=True)
    print(f"all: {planned:.1f} s of {forced:.1f} s, {100 * (1 - planned / forced):.0f} % saved")


if __name__ == "__main__":
    main()
