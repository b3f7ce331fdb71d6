"""A take of 60 frames followed by `process_sequence`.

Frames are raw-like scans of a moving face, each of its own topology: noise 0.15 mm, holes, other hair in
each; first and last frame are the same face in the same pose. In mm: the error of the 68 landmarks without
each landmark's mean offset ("motion"); "jitter", the RMS of second differences of the error, those of the
true motion, and those of the error at the nose; "drift", how much the error differs between the last frame
and the first. `process_sequence` was made with the first two people; the others judge.
"""

from collections.abc import Iterator
from functools import partial

import numpy as np
from worlds.takes import SCRIPTS, Take, take

from bench.runner import Bench, Case
from scan2albedo.core.arrays import FloatArray
from scan2albedo.geometry.rigid import invert_rigid, transform_points
from scan2albedo.pipeline.sequence import process_sequence

NOSE = slice(27, 36)


def followed(made: Take) -> FloatArray:
    """Return landmarks (T, 68, 3) in the scanner's frame."""
    result = process_sequence(made.frames, None, name="take")
    found = [
        transform_points(invert_rigid(pose), result.fitted.model.landmarks_of(points))
        for points, pose in zip(result.control_points, result.poses, strict=True)
    ]
    return np.array(found)


def figures(made: Take, landmarks: FloatArray) -> dict[str, float]:
    def jump(places: FloatArray) -> float:
        return float(np.sqrt((np.diff(places, 2, axis=0) ** 2).sum(2).mean()))

    error = landmarks - made.landmarks
    return {
        "motion": float(np.linalg.norm(error - error.mean(0), axis=2).mean()),
        "jitter": jump(error),
        "true": jump(made.landmarks),
        "nose": jump(error[:, NOSE]),
        "drift": float(np.linalg.norm(error[-1] - error[0], axis=1).mean()),
    }


def cases(quick: bool) -> Iterator[Case]:
    for number, (person, script) in enumerate(SCRIPTS.items(), 1):
        frames = 6 if quick else 60
        yield Case(person, partial(take, person, script, count=frames, seed=number))
        if quick:
            return


BENCH = Bench(cases, methods={"followed": followed}, score=figures)
