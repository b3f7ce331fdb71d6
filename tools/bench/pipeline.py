"""The whole pipeline: each stage's CPU, presets, budgets in seconds, and what is left out.

`stages` are those of the real scan, or of a synthetic one where that is absent, in a process that is warm;
`commands` are whole commands as a user types them, with imports, pictures and files; `first` is the first run
after an installation, everything with all files by a new process without compiled kernels, alone and with
helpers beside it, and once more with the kernels that it left (wall seconds). `presets` and `budgets` are of
synthetic people scanned with one or two flashes, without files; errors are of the surface where skin was
scanned (not under hair), of dense correspondence there, of 51 landmarks, and of the albedo on its own texels.
Budgets are shares of the wall seconds of a run without one; "over s" is by how much it was overrun.
`left_out` processes scenes as the evidence decides, and with every optional step forced; errors are of the
albedo (relative RMSE in percent after the best single scale).
"""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np
from worlds.files import DATA, face_data
from worlds.fits import fitted_face
from worlds.synthetic_scans import scanned_skin

import scan2albedo as s2a
from bench.runner import Bench, Case, Timed
from scan2albedo.albedo import OPTIONAL_STEPS, EstimateOptions
from scan2albedo.core import Plan
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.rigid import invert_rigid, transform_points
from scan2albedo.pipeline.demo import compare_with_truth
from scan2albedo.pipeline.quality import PRESETS, STEPS
from scan2albedo.synthetic import Material, Scanner, SyntheticTruth, face, hemisphere, light_at, raw_scan
from scan2albedo.synthetic.scenes import SyntheticScene

REAL_SCAN = DATA / "james.obj"
SIZE = 512
QUICK_SIZE = 64
SHARES = (0.01, 0.25, 0.5, 0.75, 1.0, 1.5)
"""Budgets, of what a run without one takes."""
FIRST = """
import sys
import time

begin = time.perf_counter()
import scan2albedo as s2a

s2a.process(sys.argv[1], out=sys.argv[2])
print(time.perf_counter() - begin)
"""
GLOSSY = Material(sigma_rad=0.3, specular_strength=0.1, specular_exponent=20.0)
MATT = Material(sigma_rad=0.0)

Work = Callable[[], Any]


@cache
def scan() -> s2a.RawScan:
    return s2a.load_scan(REAL_SCAN) if REAL_SCAN.is_file() else raw_scan(0)[0]


@cache
def fitted_scan() -> s2a.FittedFace:
    return fitted_face(scan())


def whole_run(size: int) -> None:
    with tempfile.TemporaryDirectory() as out:
        s2a.process(REAL_SCAN if REAL_SCAN.is_file() else scan(), out, size=size)


def stages(quick: bool) -> Iterator[Case]:
    """Yield stages; a scene is what runs one."""
    size = QUICK_SIZE if quick else SIZE
    model = s2a.AnnotatedFaceModel.default()

    def fit() -> Work:
        pose = s2a.register(scan(), model)
        return lambda: s2a.fit(scan(), model, pose)

    def albedo() -> Work:
        image = s2a.geometry_image(fitted_scan(), scan(), size)
        return lambda: s2a.estimate_albedo(image)

    if REAL_SCAN.is_file():
        yield Case("load", lambda: lambda: s2a.load_scan(REAL_SCAN))
    yield Case("register", lambda: lambda: s2a.register(scan(), model))
    yield Case("fit", fit)
    yield Case("geometry image", lambda: partial(s2a.geometry_image, fitted_scan(), scan(), size))
    yield Case("light and albedo", albedo)
    yield Case("whole run with files", lambda: partial(whole_run, size), "everything")


@dataclass(frozen=True)
class Waited:
    """How long a command took by the clock, and the most memory that it had."""

    wall_s: float
    peak_mb: float


def run_command(words: Sequence[str]) -> Timed:
    """Run `scan2albedo` with these words as a process of its own; its CPU seconds include its children's.

    Raises
    ------
    ScanError
        With what it said, where it ends with another status than 0 or 1: results with something left out.
    """
    start = time.perf_counter()
    command = [sys.executable, "-m", "scan2albedo", *words]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    said = process.stderr.read()
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode not in (0, 1):
        raise s2a.ScanError(said)
    waited = Waited(time.perf_counter() - start, usage.ru_maxrss / 1024)
    return Timed(waited, usage.ru_utime + usage.ru_stime)


def commands(quick: bool) -> Iterator[Case]:
    """Yield commands on the real scan; what comes after a result gets one that the first of them made."""
    face_data("james.obj")
    out = folder_for("results").name
    result = f"{out}/standard/{REAL_SCAN.stem}"
    lines = {
        "process": f"process {REAL_SCAN} -o {out}/standard",
        "draft": f"process {REAL_SCAN} -o {out}/draft --quality draft --files minimal --no-pictures",
        "relight": f"relight {result} --light 40,20 -o {out}/relit.png",
        "report": f"report {result} -o {out}/report.html",
        "version": "--version",
    }
    for name in ["version"] if quick else lines:
        yield Case(name, lambda name=name: lines[name].split(), group=name)


@cache
def folder_for(name: str) -> tempfile.TemporaryDirectory[str]:
    """Return a folder of that name, which is gone when the bench ends."""
    return tempfile.TemporaryDirectory(prefix=name)


def first_run(folder: str) -> float:
    """Return the wall seconds of `process` in a new process that keeps its kernels in a folder."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": folder_for(folder).name}
    with tempfile.TemporaryDirectory() as out:
        command = [sys.executable, "-c", FIRST, str(REAL_SCAN), out]
        done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return float(done.stdout)


def first_runs(quick: bool) -> Iterator[Case]:
    face_data("james.obj")
    for name in ("first run", "next run, by a new process"):
        yield Case(name, lambda: partial(first_run, "kernels"))


Person = tuple[s2a.RawScan, SyntheticTruth]


@cache
def person(seed: int, size: int) -> Person:
    return raw_scan(seed, scanner=Scanner(size=size))


def people(sizes: tuple[int, ...], count: int, quick: bool) -> Iterator[Case]:
    """Yield people; a scene has a scan and its truth for each size of the image."""
    for seed in range(1 if quick else count):
        yield Case(f"person {seed}", lambda seed=seed: {size: person(seed, size) for size in sizes})


@dataclass(frozen=True)
class Run:
    """What a run gave on a scan, its wall seconds and the budget that it had."""

    result: s2a.ProcessResult
    person: Person
    wall_s: float
    budget_s: float = np.inf


def processed(made: Person, quality: s2a.Quality, budget_s: float | None = None) -> Run:
    start = time.perf_counter()
    result = s2a.process(made[0], quality=quality, budget=budget_s)
    wall_s = time.perf_counter() - start
    return Run(result, made, wall_s, np.inf if budget_s is None else budget_s)


def with_preset(scene: dict[int, Person], name: str) -> Run:
    return processed(scene[PRESETS[name].size], PRESETS[name])


def errors(scene: Any, run: Run) -> dict[str, float]:
    """Return errors over the true texels that were scanned, and of the whole result."""
    scan, truth = run.person
    fitted = run.result.fitted
    image = run.result.geometry_image
    truth_from_fit = truth.model_from_scan @ invert_rigid(fitted.model_from_scan)
    both = image.mask & truth.image.mask
    true = truth.image.position[both]
    skin = scanned_skin(scan, truth, true)
    surface = ClosestPointQuery(transform_points(truth_from_fit, fitted.vertices), fitted.faces)
    apart = np.linalg.norm(transform_points(truth_from_fit, image.position[both]) - true, axis=1)
    report = compare_with_truth(run.result, truth)
    row = {
        "surface mm": float(surface.query(true).distance[skin].mean()),
        "corr. mm": float(apart[skin].mean()),
        "landmarks mm": report.landmarks_mm,
        "albedo %": 100 * report.albedo.relative_rmse,
        "MSE %": report.albedo.mse_percent,
        "light deg": report.light_deg,
        "wall s": run.wall_s,
    }
    return row if np.isinf(run.budget_s) else row | {"over s": run.wall_s - run.budget_s}


def with_share(scene: tuple[Person, float], share: float) -> Run:
    made, free_s = scene
    return processed(made, PRESETS["standard"], share * free_s if share else None)


def budget_cases(quick: bool) -> Iterator[Case]:
    """Yield people with the wall seconds that a run without a budget takes."""

    def made(seed: int) -> tuple[Person, float]:
        own = person(seed, PRESETS["standard"].size)
        # The first run may compile.
        processed(own, PRESETS["standard"])
        return own, processed(own, PRESETS["standard"]).wall_s

    for seed in range(1 if quick else 3):
        yield Case(f"person {seed}", partial(made, seed))


@dataclass(frozen=True)
class Estimated:
    """What ran, and the albedo's error in percent, NaN where there is no albedo."""

    plan: Plan
    error: float


def of_image(scene: SyntheticScene, forced: bool) -> Estimated:
    options = EstimateOptions(force=OPTIONAL_STEPS if forced else ())
    found = s2a.estimate_albedo(scene.image, options=options)
    error = s2a.albedo_error(found.albedo_linear, scene.albedo_linear, scene.image.seen).relative_rmse
    return Estimated(found.plan, 100 * error)


def of_scan(
    scan: s2a.RawScan, truth: SyntheticTruth, size: int, model: str | None, forced: bool
) -> Estimated:
    result = s2a.process(scan, size=size, model=model, force=STEPS if forced else ())
    if result.albedo is None or result.fitted is None:
        return Estimated(result.plan, np.nan)
    return Estimated(result.plan, 100 * compare_with_truth(result, truth).albedo.relative_rmse)


def needless_steps(quick: bool) -> Iterator[Case]:
    """Yield scenes; each is a function of whether every step is forced."""
    size = QUICK_SIZE if quick else 256
    side = [light_at(45, 15)]
    kinds: dict[str, Callable[..., SyntheticScene]] = {
        "hemisphere, matt": partial(hemisphere, texture="wood", lights=side, material=MATT),
        "face, matt, from the front": partial(face, lights=[light_at(0, 10)], material=MATT),
        "face, matt, from the side": partial(face, lights=side, material=MATT),
        "face, glossy": partial(face, lights=side, material=GLOSSY),
        "face, glossy, flash at 600 mm": partial(
            face, lights=[light_at(30, 20, distance_mm=600.0)], material=GLOSSY
        ),
        "face, matt, two lights": partial(face, lights=[light_at(-50, 10), light_at(50, 20)], material=MATT),
        "face, overexposed": partial(face, lights=side, material=GLOSSY, exposure=1.8),
        "face, 1 % noise": partial(face, lights=side, material=MATT, noise=0.01),
    }
    for seed in range(1 if quick else 2):
        for name, make in kinds.items():
            yield Case(
                f"{name} ({seed})", lambda make=make, seed=seed: partial(of_image, make(size=size, seed=seed))
            )

        def scanned(seed: int, colored: bool, model: str | None) -> Callable[..., Estimated]:
            scan, truth = person(seed, size)
            scan = scan if colored else replace(scan, uv=None, texture_linear=None)
            return partial(of_scan, scan, truth, size, model)

        yield Case(f"raw scan ({seed})", partial(scanned, seed, True, None))
        yield Case(f"raw scan without colour ({seed})", partial(scanned, seed, False, None))
        yield Case(f"raw scan, --model none ({seed})", partial(scanned, seed, True, "none"))


def plan_of(scene: Any, found: Estimated) -> dict[str, float | str]:
    left_out = ", ".join(step.stage for step in found.plan if not step.ran)
    return {"error %": found.error, "left out": left_out}


RUN: dict[str, Callable[[Work], Any]] = {"scan2albedo": lambda work: work()}
BENCHES = {
    "stages": Bench(stages, RUN, lambda work, value: {}, repeats=2, summaries=()),
    "commands": Bench(
        commands,
        {"scan2albedo": run_command},
        lambda words, waited: {"wall s": waited.wall_s, "peak MB": waited.peak_mb},
        repeats=2,
        summaries=(),
    ),
    "first": Bench(first_runs, RUN, lambda work, wall_s: {"wall s": wall_s}, summaries=()),
    "presets": Bench(
        partial(people, tuple(quality.size for quality in PRESETS.values()), 6),
        methods={name: partial(with_preset, name=name) for name in PRESETS},
        score=errors,
        quick=("draft",),
        warm=True,
    ),
    "budgets": Bench(
        budget_cases,
        methods={"no budget": partial(with_share, share=0.0)}
        | {f"{100 * share:g} %": partial(with_share, share=share) for share in SHARES},
        score=errors,
        quick=("1 %", "50 %"),
    ),
    "left_out": Bench(
        needless_steps,
        methods={
            "as planned": lambda scene: scene(forced=False),
            "all forced": lambda scene: scene(forced=True),
        },
        score=plan_of,
        repeats=2,
        warm=True,
    ),
}
