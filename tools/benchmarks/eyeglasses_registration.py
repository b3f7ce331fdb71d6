"""Registration on synthetic wearers: errors by case, error against run time, and Adam on the same loss."""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import partial
from itertools import count, islice
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.glasses import WornGlasses, worn_glasses
from scan2albedo.core import Budget, Meter
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.eyeglasses import (
    FaceRegistrationOptions,
    RegisteredEyeglasses,
    register_on_face,
)
from scan2albedo.eyeglasses.on_face.frame_motion import FrameState, SkinnedPoints
from scan2albedo.eyeglasses.on_face.inputs import checked_inputs
from scan2albedo.eyeglasses.on_face.objective import (
    Linearization,
    RegistrationObjective,
    descend,
)
from scan2albedo.eyeglasses.on_face.outline import FrameMesh, OutlineSampler, OutlineSamples
from scan2albedo.eyeglasses.on_face.report import mark_deviations
from scan2albedo.eyeglasses.on_face.start_poses import starting_poses
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.synthetic import Wearer, wearer

CASES: dict[str, dict[str, Any]] = {
    "exact": {"label_noise_px": 0, "mask_noise_px": 0},
    "1 px / 1 px": {},
    "4 px / 2 px": {"label_noise_px": 4, "mask_noise_px": 2},
    "3 outliers a view": {"outliers": 3},
    "8 key points missing": {"missing": 8},
    "hair over temples": {"hair": True},
}
ADAM_STEPS_MM = (1.0, 0.3, 0.1, 0.03)
ADAM_ITERATIONS = 3000
LEVER_MM = 60.0
"""How far a frame reaches from its middle: a radian counts as that many millimetres for Adam."""


def register(worn: Wearer, seed: int, **changes: Any) -> RegisteredEyeglasses:
    glasses = worn.glasses
    given = {"masks": worn.masks, "head": (worn.head_vertices, worn.head_faces), **changes}
    frame = (glasses.rest_vertices, glasses.faces, glasses.rest_keypoints, worn_glasses(seed).weights)
    return register_on_face(frame, worn.labels, cameras=worn.cameras, **given)


def rms(found: RegisteredEyeglasses, worn: Wearer, where: BoolArray) -> float:
    return float(np.sqrt((np.linalg.norm(found.vertices - worn.vertices, axis=1)[where] ** 2).mean()))


def bench_cases(seeds: int) -> None:
    """Print errors of what is visible, of what is called observed, and what was predicted."""
    heads = ("pose", "labels", "all", "worst", "observed", "predicted", "CPU s")
    print(f"{'case':22}" + "".join(f"{head:>10}" for head in heads))
    register(wearer(0), 0)
    for name, options in CASES.items():
        rows = []
        for seed in range(seeds):
            worn = wearer(seed, **options)
            cpu = time.process_time()
            found = register(worn, seed)
            cpu = time.process_time() - cpu
            stages = [
                rms(
                    register(worn, seed, masks=None, options=FaceRegistrationOptions(bend=bend)),
                    worn,
                    worn.seen,
                )
                for bend in (False, True)
            ]
            predicted = float(np.sqrt((found.deviation[worn.seen] ** 2).mean()))
            rows.append(
                [*stages, rms(found, worn, worn.seen), rms(found, worn, found.observed), predicted, cpu]
            )
        table = np.array(rows)
        pose, labels, every, observed, predicted, cpu = table.mean(0)
        print(
            f"{name:22}{pose:10.2f}{labels:10.3f}{every:10.3f}{table[:, 2].max():10.3f}{observed:10.3f}"
            f"{predicted:10.3f}{cpu:10.2f}"
        )


def bench_budget(seeds: int) -> list[tuple[str, float, float]]:
    """Print the mean error after budgets of evaluations; return (name, CPU s, mm)."""
    rows = []
    print("error against run time, 1 px / 1 px:")
    for evaluations in (1, 2, 4, 8, 12, 16, 24, 32, 48, 96):
        errors, seconds = [], []
        for seed in range(seeds):
            worn = wearer(seed)
            cpu = time.process_time()
            found = register(worn, seed, budget=Budget(evaluations=evaluations))
            seconds.append(time.process_time() - cpu)
            errors.append(rms(found, worn, worn.seen))
        rows.append((f"{evaluations}", float(np.mean(seconds)), float(np.mean(errors))))
        print(f"  {evaluations:4} evaluations  {np.mean(seconds):6.2f} s CPU  {np.mean(errors):7.3f} mm rms")
    return rows


class SameLoss:
    """One wearer's labels and outlines, traced once, from the unbent pose: the loss that both descend.

    Parameters
    ----------
    scene : WornGlasses
    """

    def __init__(self, scene: WornGlasses) -> None:
        worn, options = scene.worn, FaceRegistrationOptions()
        glasses = worn.glasses
        frame = (glasses.rest_vertices, glasses.faces, glasses.rest_keypoints, scene.weights)
        head = (worn.head_vertices, worn.head_faces)
        given = checked_inputs(frame, worn.labels, worn.masks, worn.cameras, head, None)
        self.objective = RegistrationObjective(given.keypoints, given.views, options)
        self.start: FrameState = starting_poses(given.keypoints, given.views, options.label_noise_px, None)[0]
        mesh = FrameMesh(SkinnedPoints(given.vertices, scene.weights), given.faces)
        self.points, self.unit = mesh.points, given.unit
        assert given.head is not None
        sampler = OutlineSampler(mesh, given.views, RayCaster(*given.head))
        near = self.descend(None)
        motion = self.objective.motion(near[0])
        self.samples: OutlineSamples = sampler.sample(motion, mark_deviations(given, motion, near[1]))

    def descend(self, samples: OutlineSamples | None) -> tuple[FrameState, Linearization]:
        found = descend(
            partial(self.objective.linearize, samples=samples),
            self.start,
            Meter("bench", "px"),
            steps=60,
            tolerance=1e-6,
            error="cost",
        )
        return found.state, found.at

    def adam(self, step_mm: float, enough: float) -> tuple[float, int]:
        """Return the least cost and the iterations after which it was at most `enough`, or all."""
        least = np.inf
        for n, (_, cost) in enumerate(islice(self.adam_steps(step_mm), ADAM_ITERATIONS), 1):
            least = min(least, cost)
            if least <= enough:
                return least, n
        return least, ADAM_ITERATIONS

    def adam_state(self, step_mm: float, iterations: int) -> FrameState:
        """Return the best state of so many iterations."""
        return min(islice(self.adam_steps(step_mm), iterations), key=lambda step: step[1])[0]

    def adam_steps(self, step_mm: float) -> Iterator[tuple[FrameState, float]]:
        """Yield states and their costs."""
        state, scale = self.start, np.r_[np.full(3, LEVER_MM), np.ones(63)]
        first, second = np.zeros(66), np.zeros(66)
        for n in count(1):
            at = self.objective.linearize(state, self.samples)
            yield state, at.cost
            gradient = at.gradient / scale
            first = 0.9 * first + 0.1 * gradient
            second = 0.999 * second + 0.001 * gradient**2
            way = first / (1 - 0.9**n) / (np.sqrt(second / (1 - 0.999**n)) + 1e-12)
            state = state.moved(-step_mm * way / scale)

    def vertices(self, state: FrameState) -> FloatArray:
        """Return the frame (V, 3) at a state."""
        return self.unit * self.objective.motion(state).positions(self.points)


def bench_adam(seeds: int) -> None:
    """Print CPU of our descent and of Adam, which stops as soon as it is within 1 % of our cost."""
    print("the same loss (labels, outlines traced once, bend's prior) from the unbent pose:")
    for seed in range(seeds):
        problem = SameLoss(worn_glasses(seed))
        with threadpool_limits(1, "blas"):
            cpu = time.process_time()
            _, at = problem.descend(problem.samples)
            ours = time.process_time() - cpu
            tried = []
            for step_mm in ADAM_STEPS_MM:
                cpu = time.process_time()
                least, iterations = problem.adam(step_mm, 1.01 * at.cost)
                tried.append((least <= 1.01 * at.cost, time.process_time() - cpu, least, iterations, step_mm))
        reached = [row for row in tried if row[0]]
        _, theirs, least, iterations, step_mm = (
            min(reached, key=lambda row: row[1]) if reached else min(tried, key=lambda row: row[2])
        )
        print(
            f"  wearer {seed}: ours {ours:.3f} s, cost {at.cost:.1f}; Adam {theirs:.2f} s, cost {least:.1f} "
            f"after {iterations} steps of {step_mm:g} mm ({'reached' if reached else 'not reached'}); "
            f"ratio {ours / theirs:.3f}"
        )


def bench_registration(seeds: int, pictures: Path | None) -> None:
    bench_cases(seeds)
    rows = bench_budget(min(seeds, 4))
    bench_adam(min(seeds, 4))
    if pictures is not None:
        _draw(rows, pictures)


def _draw(rows: list[tuple[str, float, float]], folder: Path) -> None:
    from matplotlib.figure import Figure

    folder.mkdir(parents=True, exist_ok=True)
    figure = Figure(figsize=(5, 3.4), layout="constrained")
    axis = figure.subplots()
    axis.loglog([row[1] for row in rows], [row[2] for row in rows], "o-")
    for name, seconds, error in rows:
        axis.annotate(name, (seconds, error), textcoords="offset points", xytext=(4, 4), fontsize=7)
    axis.set_xlabel("CPU [s] (numbers: evaluations)")
    axis.set_ylabel("rms of visible vertices [mm]")
    axis.grid(True, which="both", alpha=0.3)
    figure.savefig(folder / "registration_error_vs_time.png", dpi=120)
