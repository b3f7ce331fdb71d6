"""Do stages keep a budget in seconds, and have they done by then what they had done without one?

A stage runs without limit, and its trace tells when the logarithm of its error had gained 95 % of all that it
gained: t*. Run with t* seconds ("knee") it should reach 90 % of what it reaches without ("reached"), and end
then; with 0.01 s hardly anything can be done. Budgets are counted by the wall clock, in which the
machine's other work shows: "over s" is the part of the wall time beyond the budget, times the run's own CPU
time over its wall time.
"""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from worlds.model_faces import (
    albedo_error as vertex_error,
    geometry_scene,
    learned,
    person,
    rigid_error_mm,
    shape_model,
    shot,
    surface,
)
from worlds.synthetic_scans import scan_scenes

from bench.albedo import TWO_LIGHTS, value_of
from bench.fit import errors_on_skin, moved_model, of_fit
from bench.peers.registration import Surface, centered
from bench.registration import Found, off_their_place
from bench.runner import Bench, Case
from scan2albedo.albedo import albedo_error, estimate_albedo
from scan2albedo.core import GeometryImage, ProgressCallback, TraceRow
from scan2albedo.core.arrays import FloatArray
from scan2albedo.fitting import fit
from scan2albedo.geometry.rigid import invert_rigid
from scan2albedo.reflectance import finetune, fit_image, refine_geometry
from scan2albedo.registration import register
from scan2albedo.synthetic import face

GAIN = 0.95
"""Part of the trace's gain that is reached at t*."""
FEWEST_ROWS = 3
LEAST_ERROR = 1e-12
AS_GOOD = 1.01
"""Where an error cannot fall, it may rise by this factor."""

Run = Callable[[float | None, ProgressCallback | None], Any]


@dataclass(frozen=True)
class Stage:
    """A stage on one scene: how it runs, its error against the truth, and the error before it has begun."""

    run: Run
    error: Callable[[Any], float]
    start_error: float


@dataclass(frozen=True)
class Spent:
    """What a run within a budget found, and what it took."""

    found: Any
    budget_s: float
    wall_s: float
    cpu_s: float


@dataclass(frozen=True)
class Scene:
    """A stage, its error without a limit, and t*."""

    stage: Stage
    full_error: float
    knee_s: float


def time_of_gain(rows: Sequence[tuple[float, TraceRow]]) -> float:
    """Return when the logarithm of a trace's last error measure had gained `GAIN` of all that it gained.

    `rows` are seconds since the stage began, and rows. Errors of another stage or unit are another measure;
    the last one with three rows or more counts, or the last one at all. inf without rows of finite errors.
    """
    measures: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for seconds, row in rows:
        if math.isfinite(row.error):
            measures.setdefault((row.stage, row.unit), []).append((seconds, row.error))
    if not measures:
        return math.inf
    every = list(measures.values())
    chosen = next((points for points in reversed(every) if len(points) >= FEWEST_ROWS), every[-1])
    heights = [math.log(max(error, LEAST_ERROR)) for _, error in chosen]
    enough = heights[0] - GAIN * (heights[0] - min(heights))
    return next(s for (s, _), height in zip(chosen, heights, strict=True) if height <= enough)


def unlimited(make: Callable[[], Stage]) -> Scene:
    """Return a stage with its error without a limit, and t*; the first of two runs may compile."""
    stage = make()
    for _ in range(2):
        log: list[tuple[float, TraceRow]] = []
        begin = time.perf_counter()
        found = stage.run(None, lambda row: log.append((time.perf_counter() - begin, row)))  # noqa: B023
    return Scene(stage, stage.error(found), time_of_gain(log))


def within(scene: Scene, budget_s: float | None) -> Spent:
    """Run within a budget, t* for None."""
    limit = scene.knee_s if budget_s is None else budget_s
    wall, cpu = time.perf_counter(), time.process_time()
    found = scene.stage.run(limit, None)
    return Spent(found, limit, time.perf_counter() - wall, time.process_time() - cpu)


def kept(scene: Scene, run: Spent) -> dict[str, float]:
    error = scene.stage.error(run.found)
    whole = scene.stage.start_error - scene.full_error
    share = float(error <= AS_GOOD * scene.stage.start_error)
    if whole > 0:
        share = (scene.stage.start_error - error) / whole
    beyond = max(run.wall_s - run.budget_s, 0.0)
    return {
        "over s": beyond * min(run.cpu_s / max(run.wall_s, 1e-9), 1.0),
        "reached %": 100 * share,
        "budget s": run.budget_s,
    }


def registering(spacing_mm: float) -> Stage:
    scene = scan_scenes(1, spacing_mm)[0]

    def error(pose: FloatArray) -> float:
        return off_their_place(scene, Found(pose))["mm"]

    start = invert_rigid(centered(Surface(*scene.model.surface(1)), scene.scan))

    def run(budget: float | None, on_progress: ProgressCallback | None) -> FloatArray:
        return register(scene.scan, scene.model, budget, on_progress=on_progress).model_from_scan

    return Stage(run, error, error(start))


def fitting(spacing_mm: float) -> Stage:
    scene = scan_scenes(1, spacing_mm)[0]
    pose = scene.found_pose

    def error(found: Any) -> float:
        return errors_on_skin(scene, found)["surface mm"]

    def run(budget: float | None, on_progress: ProgressCallback | None) -> Any:
        return of_fit(scene, fit(scene.scan, scene.model, pose, budget, on_progress=on_progress))

    return Stage(run, error, error(moved_model("", scene).answer))


def estimating(size: int) -> Stage:
    scene = face(3, size=size, texture="skin", lights=TWO_LIGHTS, noise=0.005)
    truth = value_of(scene.albedo_linear)
    # An occluder of about 128 x 128 texels has as many triangles as a fitted face.
    part = slice(None, None, max(size // 128, 1))
    coarse = GeometryImage(
        scene.image.position[part, part], scene.image.normal[part, part], scene.image.mask[part, part]
    )
    image = replace(scene.image, occluder=coarse.triangulated())

    def error(value: FloatArray) -> float:
        return albedo_error(value, truth, image.mask).mse_percent

    def run(budget: float | None, on_progress: ProgressCallback | None) -> FloatArray:
        found = estimate_albedo(image, budget=budget, on_progress=on_progress)
        return value_of(found.albedo_linear)

    return Stage(run, error, error(value_of(image.texture_linear)))


def fitting_image() -> Stage:
    model = learned(40, 30)
    truth = person(3)
    observation = shot(truth, 3)

    def run(budget: float | None, on_progress: ProgressCallback | None) -> FloatArray:
        found = fit_image(observation, model, budget=budget, on_progress=on_progress)
        return found.face.reflectance.diffuse_linear

    def error(albedo: FloatArray) -> float:
        return 100 * vertex_error(albedo, truth)

    return Stage(run, error, error(model.diffuse.mean))


def refining_geometry() -> Stage:
    scene = geometry_scene(0)
    shapes = shape_model(60)

    def run(budget: float | None, on_progress: ProgressCallback | None) -> FloatArray:
        return refine_geometry(
            scene.image_linear,
            scene.camera,
            scene.landmarks_px,
            shapes,
            reflectance=scene.reflectance,
            light=scene.light,
            mask=scene.skin,
            budget=budget,
            on_progress=on_progress,
        ).vertices

    def error(vertices: FloatArray) -> float:
        return rigid_error_mm(vertices, scene.vertices)

    return Stage(run, error, error(shapes.mean))


def finetuning() -> Stage:
    model = learned(8, 7)
    seen = [shot(person(k), k) for k in range(8)]
    own = surface()

    def run(budget: float | None, on_progress: ProgressCallback | None) -> float:
        given = {"vertices": own.vertices, "budget": budget, "on_progress": on_progress}
        return finetune(model, seen[::2], seen[1::2], own.faces, **given).held_out_after

    start = np.mean([fit_image(image, model).objective for image in seen[1::2]])
    return Stage(run, float, float(start))


def cases(quick: bool) -> Iterator[Case]:
    spacing_mm = 4.0 if quick else 2.2
    stages = {
        "register": partial(registering, spacing_mm),
        "fit": partial(fitting, spacing_mm),
        "albedo": partial(estimating, 64 if quick else 512),
        "fit_image": fitting_image,
        "refine_geometry": refining_geometry,
        "finetune": finetuning,
    }
    for name, make in list(stages.items())[: 3 if quick else None]:
        yield Case(name, partial(unlimited, make))


BENCH = Bench(
    cases,
    methods={
        "knee": partial(within, budget_s=None),
        "0.01 s": partial(within, budget_s=0.01),
    },
    score=kept,
)
