"""Frames of eyeglasses from files to canonical space; one that cannot be done leaves the others alone."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core import Budget, ProgressCallback
from scan2albedo.errors import EyeglassesError, Scan2AlbedoError
from scan2albedo.eyeglasses import CanonicalizationOptions, CanonicalSet, canonicalize
from scan2albedo.eyeglasses.app.input import GlassesFrame, read_frame
from scan2albedo.eyeglasses.files.keypoint_files import read_keypoints_with_unit
from scan2albedo.io.units import MM_PER_UNIT

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class FailedFrame:
    """A mesh file that could not be done, and why."""

    file: Path
    reason: str


@dataclass(frozen=True)
class CanonicalFiles:
    """What became of some mesh files; `frames` and `result.frames` go together."""

    frames: tuple[GlassesFrame, ...]
    result: CanonicalSet
    failures: tuple[FailedFrame, ...]
    options: Mapping[str, Any] = field(default_factory=dict)
    seconds: float = 0.0


def read_frames(
    meshes: Sequence[Path], keypoints: Sequence[Path] | None = None, unit: str = "auto"
) -> tuple[list[GlassesFrame], list[FailedFrame]]:
    """Read meshes and their key points, as `read_frame` does, and tell what cannot be read."""
    frames, failures = [], []
    for i, mesh in enumerate(meshes):
        try:
            frames.append(read_frame(mesh, None if keypoints is None else keypoints[i], unit))
        except Scan2AlbedoError as error:
            failures.append(FailedFrame(mesh, str(error)))
    return frames, failures


def canonicalize_frames(
    frames: Sequence[GlassesFrame],
    failures: Sequence[FailedFrame] = (),
    *,
    mean: Path | None = None,
    handles: Literal["turned", "translated"] = "turned",
    budget: Budget | float | None = None,
    on_progress: ProgressCallback | None = None,
) -> CanonicalFiles:
    """Bring frames to the mean of their key points, or to that of an earlier set.

    Parameters
    ----------
    frames : sequence of GlassesFrame
    failures : sequence of FailedFrame
        From reading; those of canonicalising are added.
    mean : Path, optional
        An earlier set's `mean_keypoints.json`.
    handles, budget, on_progress
        As in `canonicalize`.

    Raises
    ------
    EyeglassesError
        When no frame can be done, or `mean` cannot be read.
    """
    begun = time.perf_counter()
    spend = Budget.of(budget)
    result = canonicalize(
        [frame.scan for frame in frames],
        [frame.keypoints for frame in frames],
        mean_keypoints=None if mean is None else _mean_mm(mean),
        budget=spend,
        options=CanonicalizationOptions(handles=handles, skip_failed=True),
        on_progress=on_progress,
    )
    lost = [FailedFrame(frames[i].mesh_file, reason) for i, reason in result.failures.items()]
    return CanonicalFiles(
        frames=tuple(frames[i] for i in result.numbers),
        result=result,
        failures=(*failures, *lost),
        options={
            "handles": handles,
            "mean": mean,
            "budget_s": spend.seconds,
            "budget_evaluations": spend.evaluations,
        },
        seconds=time.perf_counter() - begun,
    )


def _mean_mm(path: Path) -> FloatArray:
    mean = read_keypoints_with_unit(path)
    if mean.unit == "unknown":
        raise EyeglassesError(f"key points {path} do not say their unit; a mean needs one: mm, cm or m")
    return mean.points * MM_PER_UNIT[mean.unit]
