"""Stated deviations beside true errors, on frames and bends that the model does not contain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.eyeglasses_scenes import (
    BareFrame,
    Errors,
    giraut,
    khronos,
    photographed,
    synthetic,
    without_lenses,
)
from scan2albedo.core.arrays import FloatArray
from scan2albedo.eyeglasses import RegisteredEyeglasses, register_on_face

CASES = {
    "labels and masks": (Errors(), True),
    "labels only": (Errors(), False),
    "careful": (Errors(0.15, 0.7, 0.3, 0.7), True),
    "careless": (Errors(0.6, 1.7, 1.2, 1.5), True),
}
"""Errors, and whether there are masks; labels are off by 1 px an axis where careful, 3 px where careless."""


@dataclass(frozen=True)
class Misses:
    """True errors and stated deviations of many points, mm."""

    error: FloatArray
    stated: FloatArray

    def figures(self) -> tuple[float, float, float]:
        """Return shares within one and two deviations, and the ratio of root mean squares."""
        ratio = np.sqrt((self.error**2).mean() / (self.stated**2).mean())
        within = [float((self.error <= n * self.stated).mean()) for n in (1, 2)]
        return within[0], within[1], float(ratio)


def registered(frame: BareFrame, seed: int, errors: Errors, masked: bool) -> tuple[Misses, Misses]:
    """Return the misses of a frame's observed vertices and key points."""
    seen = photographed(frame, seed, errors=errors, glass=False)
    found = register_on_face(
        (frame.vertices, frame.faces, frame.keypoints, frame.weights()),
        seen.labels,
        list(seen.masks) if masked else None,
        seen.cameras,
        shapes=[seen.masks.shape[1:]] * 3,
    )
    return misses(found, seen.vertices, seen.keypoints)


def misses(found: RegisteredEyeglasses, vertices: FloatArray, keypoints: FloatArray) -> tuple[Misses, Misses]:
    """Return those of the vertices and the key points that are called observed."""
    off = np.linalg.norm(found.vertices - vertices, axis=1)[found.observed]
    marks = found.keypoints_observed
    mark_off = np.linalg.norm(found.keypoints - keypoints, axis=1)[marks]
    return Misses(off, found.deviation[found.observed]), Misses(mark_off, found.keypoint_deviation[marks])


def _joined(parts: Sequence[Misses]) -> Misses:
    # Every frame counts the same, however many vertices it has.
    parts = [part for part in parts if len(part.error)]
    take = [np.linspace(0, len(p.error) - 1, 200).astype(int) for p in parts]
    return Misses(
        np.concatenate([p.error[t] for p, t in zip(parts, take, strict=True)]),
        np.concatenate([p.stated[t] for p, t in zip(parts, take, strict=True)]),
    )


def frames(data: Path, held_out: bool) -> list[BareFrame]:
    """Return the frames that constants were chosen on, or those that were not."""
    names = ("round", "shield") if held_out else ("aviator", "slab")
    made = [without_lenses(synthetic(name)) for name in names]
    if not data.is_dir():
        print(f"real frames are left out: {data} is not there")
        return made
    return [*made, without_lenses(khronos(data)) if held_out else giraut(data)]


def bench_deviations(data: Path, seeds: int, *, held_out: bool = True) -> None:
    """Print coverage and the ratio of true to stated errors, of vertices and of key points."""
    first = 1000 if held_out else 0
    print(f"{'frame':24}{'case':18}{'rms mm':>8}{'stated':>8}{'observed':>9}", end="")
    print(f"{'  vertices: 1 s, 2 s, ratio':>28}{'key points: 1 s, 2 s, ratio':>29}")
    every: list[tuple[Misses, Misses]] = []
    for frame in frames(data, held_out):
        for case, (errors, masked) in CASES.items():
            rows = [registered(frame, first + seed, errors, masked) for seed in range(seeds)]
            every += rows
            share = float(np.mean([len(v.error) for v, _ in rows])) / len(frame.vertices)
            _print(frame.name, case, rows, share)
    _print("all", "", every, float("nan"))


def _print(name: str, case: str, rows: list[tuple[Misses, Misses]], share: float) -> None:
    if share == 0:
        print(f"{name:24}{case:18}{'nothing is called observed':>30}")
        return
    vertices, marks = (_joined(list(part)) for part in zip(*rows, strict=True))
    rms, stated = (float(np.sqrt((v**2).mean())) for v in (vertices.error, vertices.stated))
    print(f"{name:24}{case:18}{rms:8.3f}{stated:8.3f}{share:9.2f}", end="")
    for found in (vertices, marks):
        one, two, ratio = found.figures()
        print(f"{one:12.2f}{two:7.2f}{ratio:8.2f}", end=" ")
    print(flush=True)
