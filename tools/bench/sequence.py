"""A take of 60 frames followed by `process_sequence`, beside every frame registered and fitted alone.

Frames are raw-like scans of a moving face, each of its own topology: noise 0.15 mm, holes, other hair in
each; first and last frame are the same face in the same pose. In mm: the 68 landmarks' error, also without
each landmark's mean offset ("motion"); "jitter", the RMS of second differences of the error, and those of the
true motion; "drift", how much the error differs between the last frame and the first; jitter by parts of the
face. "frame s" are CPU seconds of a frame but the first, median. `process_sequence` was made with the first
two people; the others judge.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from worlds.takes import SCRIPTS, Take, take

import scan2albedo as s2a
from bench.runner import Bench, Case
from scan2albedo.core.arrays import FloatArray
from scan2albedo.geometry.rigid import invert_rigid, transform_points
from scan2albedo.pipeline.options import PRESETS
from scan2albedo.pipeline.sequence import process_sequence

PARTS = {
    "jaw": slice(0, 17),
    "brows": slice(17, 27),
    "nose": slice(27, 36),
    "eyes": slice(36, 48),
    "mouth": slice(48, 68),
}


@dataclass(frozen=True)
class Followed:
    """Landmarks (T, 68, 3) in the scanner's frame, and CPU seconds of frames."""

    landmarks: FloatArray
    cpu_s: FloatArray


def followed(made: Take) -> Followed:
    result = process_sequence(made.frames, None, name="take")
    found = [
        transform_points(invert_rigid(pose), result.fitted.model.landmarks_of(points))
        for points, pose in zip(result.control_points, result.poses, strict=True)
    ]
    return Followed(np.array(found), np.array([frame["cpu_s"] for frame in result.frames[1:]]))


def alone(made: Take) -> Followed:
    model = s2a.AnnotatedFaceModel.default()
    stages = PRESETS["draft"]
    found, cpu_s = [], []
    for scan in made.frames:
        start = time.process_time()
        pose = s2a.register(scan, model, options=stages.registration)
        fitted = s2a.fit(scan, model, pose, options=stages.fit)
        cpu_s.append(time.process_time() - start)
        found.append(transform_points(invert_rigid(fitted.model_from_scan), fitted.landmarks))
    return Followed(np.array(found), np.array(cpu_s[1:]))


def figures(made: Take, answer: Followed) -> dict[str, float]:
    error = answer.landmarks - made.landmarks
    jump = np.diff(error, 2, axis=0)
    drift = np.linalg.norm(error[-1] - error[0], axis=1)
    row = {
        "error": np.linalg.norm(error, axis=2).mean(),
        "motion": np.linalg.norm(error - error.mean(0), axis=2).mean(),
        "jitter": np.sqrt((jump**2).sum(2).mean()),
        "true": np.sqrt((np.diff(made.landmarks, 2, axis=0) ** 2).sum(2).mean()),
        "drift": drift.mean(),
        "most drift": drift.max(),
        "frame s": np.median(answer.cpu_s),
    }
    row |= {name: np.sqrt((jump[:, part] ** 2).sum(2).mean()) for name, part in PARTS.items()}
    return {name: float(value) for name, value in row.items()}


def cases(quick: bool) -> Iterator[Case]:
    for number, (person, script) in enumerate(SCRIPTS.items(), 1):
        frames = 6 if quick else 60
        yield Case(person, partial(take, person, script, count=frames, seed=number))
        if quick:
            return


BENCH = Bench(cases, methods={"followed": followed, "alone": alone}, score=figures)
