"""Stated deviations beside true errors of registered frames, and lenses that only mesh or masks have.

"stated": real frames and others, bent by deformations that no key points know, with labels and masks whose
errors are not those assumed; labels are off by 1 px an axis where careful, 3 px where careless. Of
vertices, and of key points, that are called observed: rms of errors, of deviations, their ratio, shares
within one and two deviations (wanted: about .68 and .95). These frames and seeds set no constant. "lenses":
frames with lenses and without, on masks with lenses and without: errors of the rims' vertices.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

from bench.eyeglasses.scenes import (
    EVEN,
    BareFrame,
    BentFrame,
    Errors,
    khronos,
    named,
    photographed,
    synthetic,
    without_lenses,
)
from bench.judging import rms
from bench.runner import Bench, Case
from scan2albedo.core.arrays import FloatArray
from scan2albedo.eyeglasses import RegisteredEyeglasses, register_on_face

CASES = {
    "labels and masks": (Errors(), True),
    "labels only": (Errors(), False),
    "careful": (Errors(0.15, 0.7, 0.3, 0.7), True),
    "careless": (Errors(0.6, 1.7, 1.2, 1.5), True),
}
"""Errors, and whether there are masks."""


@dataclass(frozen=True)
class Misses:
    """True errors and stated deviations of points, mm."""

    error: FloatArray
    stated: FloatArray

    def figures(self, of: str) -> dict[str, float]:
        row = {"rms": rms(self.error), "stated": rms(self.stated)}
        row |= {f"in {k} s": float(np.mean(self.error <= k * self.stated)) for k in (1, 2)}
        return {f"{of} {name}": value for name, value in row.items()}


def misses(found: RegisteredEyeglasses, vertices: FloatArray, keypoints: FloatArray) -> tuple[Misses, Misses]:
    """Return those of the vertices and the key points that are called observed."""
    off = np.linalg.norm(found.vertices - vertices, axis=1)[found.observed]
    marks = found.keypoints_observed
    mark_off = np.linalg.norm(found.keypoints - keypoints, axis=1)[marks]
    return Misses(off, found.deviation[found.observed]), Misses(mark_off, found.keypoint_deviation[marks])


@dataclass(frozen=True)
class Seen:
    """A frame in pictures, the mesh that is registered, and whether masks are given."""

    frame: BareFrame
    mesh: BareFrame
    pictures: BentFrame
    masked: bool = True

    def register(self) -> RegisteredEyeglasses:
        mesh, seen = self.mesh, self.pictures
        return register_on_face(
            (mesh.vertices, mesh.faces, mesh.keypoints, mesh.weights()),
            seen.labels,
            list(seen.masks) if self.masked else None,
            seen.cameras,
            shapes=[seen.masks.shape[1:]] * 3,
        )


def seen(name: str, seed: int, errors: Errors, masked: bool) -> Seen:
    frame = named(name)
    return Seen(frame, frame, photographed(frame, seed, errors=errors, glass=False), masked)


def cases(quick: bool) -> Iterator[Case]:
    for name in ("round", "shield", "khronos"):
        for case, (errors, masked) in CASES.items():
            for seed in range(1000, 1001 if quick else 1002):
                yield Case(f"{name} {case} {seed}", partial(seen, name, seed, errors, masked), case)


def stated(scene: Seen, found: RegisteredEyeglasses) -> dict[str, float]:
    vertices, marks = misses(found, scene.pictures.vertices, scene.pictures.keypoints)
    row = {"observed": float(found.observed.mean())}
    return row | vertices.figures("vertices") | marks.figures("key points")


def with_or_without(name: str, own: bool, shown: bool, seed: int) -> Seen:
    frame = khronos() if name == "khronos" else synthetic(name)
    mesh = frame if own else without_lenses(frame)
    return Seen(frame, mesh, photographed(frame, seed, errors=EVEN, glass=shown))


def lens_cases(quick: bool) -> Iterator[Case]:
    for name in ("slab",) if quick else ("khronos", "aviator", "slab"):
        for own in (True, False):
            for shown in (True, False):
                for seed in range(1 if quick else 2):
                    group = f"mesh {'with' if own else 'without'}, masks {'with' if shown else 'without'}"
                    made = partial(with_or_without, name, own, shown, seed)
                    yield Case(f"{name}, {group} {seed}", made, group)


def of_rims(scene: Seen, found: RegisteredEyeglasses) -> dict[str, float | str]:
    truth, rims = scene.pictures.vertices, np.unique(scene.mesh.rims)
    if scene.mesh is not scene.frame:
        truth = truth[np.unique(scene.frame.rims)]
    steps = [step for step in found.plan if step.stage in ("glasses.lenses", "glasses.contradicted")]
    return {
        "rms mm": rms(np.linalg.norm((found.vertices - truth)[rims], axis=1)),
        "observed": float(found.observed[rims].mean()),
        "IoU": float(np.nanmin(found.iou)),
        "steps": "; ".join(sorted(f"{step.stage.partition('.')[2]} {step.evidence}" for step in steps)),
    }


BENCHES = {
    "stated": Bench(
        cases,
        methods={"scan2albedo": Seen.register},
        score=stated,
        summaries=("rms", "mean"),
    ),
    "lenses": Bench(lens_cases, methods={"scan2albedo": Seen.register}, score=of_rims),
}
