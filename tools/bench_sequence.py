"""A take of 60 frames followed by `process_sequence`, beside every frame processed alone.

    python tools/bench_sequence.py [--takes 2] [--frames 60] [--glb FOLDER]

Frames are raw-like scans of a moving face, each of its own topology: noise .15 mm, holes, other hair in each;
first and last frame are the same face in the same pose. Printed are CPU seconds a frame; the 68 landmarks'
error, also without each landmark's mean offset ("motion"); jitter, the RMS of second differences of the
error, and those of the true motion; and drift, how much the error differs between the last frame and the
first. Needs ../shared/data.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from benchmarks.takes import SCRIPTS, Take, take

import scan2albedo as s2a
from scan2albedo.core.arrays import FloatArray
from scan2albedo.geometry.rigid import invert_rigid, transform_points
from scan2albedo.pipeline.options import PRESETS
from scan2albedo.pipeline.sequence import process_sequence

PARTS = {"jaw": slice(0, 17), "brows": slice(17, 27), "nose": slice(27, 36), "eyes": slice(36, 48)}
PARTS["mouth"] = slice(48, 68)


def figures(found: FloatArray, truth: FloatArray) -> dict[str, float]:
    """Return the figures, mm, of landmarks (T, 68, 3) beside the true ones, in the scanner's frame."""
    error = found - truth
    jump = np.diff(error, 2, axis=0)
    table = {
        "error": np.linalg.norm(error, axis=2).mean(),
        "motion": np.linalg.norm(error - error.mean(0), axis=2).mean(),
        "jitter": np.sqrt((jump**2).sum(2).mean()),
        "true": np.sqrt((np.diff(truth, 2, axis=0) ** 2).sum(2).mean()),
        "drift": np.linalg.norm(error[-1] - error[0], axis=1).mean(),
        "most": np.linalg.norm(error[-1] - error[0], axis=1).max(),
    }
    for name, part in PARTS.items():
        table[name] = np.sqrt((jump[:, part] ** 2).sum(2).mean())
    return {name: float(figure) for name, figure in table.items()}


def followed(made: Take, out: Path | None = None) -> tuple[dict[str, float], FloatArray]:
    """Return the figures of `process_sequence`, and CPU seconds: of a frame but the first, of all / T."""
    begin = time.process_time()
    result = process_sequence(made.frames, out, name="take")
    total = time.process_time() - begin
    assert result.fitted is not None
    model, found = result.fitted.model, []
    for points, pose in zip(result.control_points, result.poses, strict=True):
        landmarks = model.landmarks_of(points)
        assert landmarks is not None
        found.append(transform_points(invert_rigid(pose), landmarks))
    cpu = np.array([frame["cpu_s"] for frame in result.frames[1:]])
    return figures(np.array(found), made.landmarks), np.array([np.median(cpu), total / len(made.frames)])


def alone(made: Take) -> tuple[dict[str, float], FloatArray]:
    """Return the same of registration and fit of every frame, at the same quality."""
    model, stages = s2a.AnnotatedFaceModel.default(), PRESETS["draft"]
    found, cpu = [], []
    for scan in made.frames:
        begin = time.process_time()
        pose = s2a.register(scan, model, options=stages.registration)
        fitted = s2a.fit(scan, model, pose, options=stages.fit)
        cpu.append(time.process_time() - begin)
        assert fitted.landmarks is not None
        found.append(transform_points(invert_rigid(fitted.model_from_scan), fitted.landmarks))
    return figures(np.array(found), made.landmarks), np.array([np.median(cpu), np.mean(cpu)])


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--takes", type=int, default=2, help=f"how many of the {len(SCRIPTS)}")
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--glb", type=Path, help="a folder for the results of the takes")
    arguments = parser.parse_args()
    print(
        "Landmarks in mm; jitter of parts of the face; CPU s a frame: median, and all of the run / frames\n"
    )
    for number, (person, script) in enumerate(list(SCRIPTS.items())[: arguments.takes]):
        made = take(person, script, count=arguments.frames, seed=number + 1)
        if not number:
            process_sequence(made.frames[:2], name="warm-up")  # compiles
            alone(Take(made.frames[:3], made.landmarks[:3]))
        for method in ("followed", "alone"):
            out = None if arguments.glb is None else arguments.glb / person
            found, cpu = followed(made, out) if method == "followed" else alone(made)
            if not number and method == "followed":
                print(f"{'person':10}{'method':10}{'CPU':>6}{'all':>6}" + "".join(f"{n:>8}" for n in found))
            row = "".join(f"{figure:8.2f}" for figure in found.values())
            print(f"{person:10}{method:10}{cpu[0]:6.2f}{cpu[1]:6.2f}{row}", flush=True)


if __name__ == "__main__":
    main()
