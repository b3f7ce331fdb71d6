"""Frames of eyeglasses from files to canonical space, and the files of the result."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from scan2albedo.core import Budget, ProgressCallback
from scan2albedo.core.arrays import FloatArray
from scan2albedo.core.version import VERSION
from scan2albedo.errors import EyeglassesError, Scan2AlbedoError
from scan2albedo.eyeglasses import (
    CanonicalEyeglasses,
    CanonicalizationOptions,
    CanonicalSet,
    canonicalize,
    skin,
    write_canonical,
    write_keypoints,
)
from scan2albedo.eyeglasses.canonical.canonicalization import CanonicalMode
from scan2albedo.eyeglasses.canonical.sizes import WIDTHS_MM
from scan2albedo.eyeglasses.files.frame_files import write_frame_glb
from scan2albedo.eyeglasses.files.keypoint_files import read_keypoints_with_unit
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.io.atomic import make_folder, result_folder
from scan2albedo.io.records import installed_versions, plain_json, write_record
from scan2albedo.io.result_records import InputRecord
from scan2albedo.io.skinned_glb import SkinWritten
from scan2albedo.io.units import MM_PER_UNIT
from scan2albedo.report.eyeglasses_views import CANONICAL_COLUMNS, MOST_FRAMES, DrawnFrame, glasses_panels
from scan2albedo.report.overview import overview_figure
from scan2albedo.runs.eyeglasses.input import GlassesFrame, read_frame
from scan2albedo.runs.eyeglasses.records import CanonicalFrameRecord, CanonicalSetRecord, FailedFrameRecord

FRAME_RECORD, SET_RECORD = "result.json", "set.json"
"""They come last: a folder that has one is whole."""


@dataclass(frozen=True)
class CanonicalFiles:
    """What became of some mesh files; `frames` and `result.frames` go together."""

    frames: tuple[GlassesFrame, ...]
    result: CanonicalSet
    failures: tuple[FailedFrameRecord, ...]
    notes: tuple[str, ...] = ()
    """Frames that are unlike the others, single bridges among double ones, and frames whose sides cannot be
    checked."""
    options: Mapping[str, Any] = field(default_factory=dict)
    seconds: float = 0.0


def read_frames(
    meshes: Sequence[Path],
    keypoints: Sequence[Path] | None = None,
    unit: str = "auto",
    widths_mm: tuple[float, float] = WIDTHS_MM,
) -> tuple[list[GlassesFrame], list[FailedFrameRecord]]:
    """Read meshes and their key points, as `read_frame` does, and return what cannot be read and why."""
    frames, failures = [], []
    for i, mesh in enumerate(meshes):
        try:
            frames.append(read_frame(mesh, None if keypoints is None else keypoints[i], unit, widths_mm))
        except Scan2AlbedoError as error:
            failures.append(FailedFrameRecord(file=str(mesh), reason=str(error)))
    return frames, failures


def canonicalize_frames(
    frames: Sequence[GlassesFrame],
    failures: Sequence[FailedFrameRecord] = (),
    *,
    mean: Path | None = None,
    mode: CanonicalMode = "unbend",
    handles: Literal["turned", "translated"] = "turned",
    widths_mm: tuple[float, float] = WIDTHS_MM,
    budget: Budget | float | None = None,
    on_progress: ProgressCallback | None = None,
) -> CanonicalFiles:
    """Take poses and bends away; frames go where their mean lies, or an earlier `mean_keypoints.json`.

    New failures are added to `failures` of reading. Raises EyeglassesError when no frame can be done, or
    `mean` cannot be read.
    """
    begun = time.perf_counter()
    spend = Budget.of(budget)
    result = canonicalize(
        [frame.scan for frame in frames],
        [frame.keypoints for frame in frames],
        mean_keypoints=None if mean is None else _mean_mm(mean),
        budget=spend,
        options=CanonicalizationOptions(mode=mode, handles=handles, widths_mm=widths_mm, skip_failed=True),
        on_progress=on_progress,
    )
    lost = (
        FailedFrameRecord(file=str(frames[i].mesh_file), reason=reason)
        for i, reason in result.failures.items()
    )
    return CanonicalFiles(
        frames=tuple(frames[i] for i in result.numbers),
        result=result,
        notes=(
            *(f"{frames[i].name} is unlike the others: {why}" for i, why in result.outliers.items()),
            *_notes_on_bridges([frames[i].name for i in result.single_bridges]),
            *_notes_on_sides([frames[i] for i in result.numbers]),
        ),
        failures=(*failures, *lost),
        options={
            "mode": mode,
            "handles": handles,
            "widths_mm": widths_mm,
            "mean": mean,
            "budget_s": spend.seconds,
            "budget_evaluations": spend.evaluations,
        },
        seconds=time.perf_counter() - begun,
    )


def _notes_on_bridges(single: Sequence[str]) -> list[str]:
    if not single:
        return []
    return [
        f"{', '.join(single)}: one bridge, while other frames or the mean given have two: bridge_top of the "
        "mean lies between both kinds and draws the single bridge out into a spike; leave bridge_top out of "
        "the key points of frames with one bridge, or bring the two kinds to means of their own"
    ]


def _notes_on_sides(frames: Sequence[GlassesFrame]) -> list[str]:
    bare = [frame.name for frame in frames if not frame.has_temples]
    return [f"{', '.join(bare)}: without temples, left and right cannot be checked reliably"] if bare else []


def _mean_mm(path: Path) -> FloatArray:
    mean = read_keypoints_with_unit(path)
    if mean.unit == "unknown":
        raise EyeglassesError(f"key points {path} do not say their unit; a mean needs one: mm, cm or m")
    return mean.points * MM_PER_UNIT[mean.unit]


def write_canonical_files(done: CanonicalFiles, out: Path) -> dict[str, dict[str, Any]]:
    """Write each frame's files into ``out / <name>`` and the set's into `out`; return figures by frame name.

    The figures are as in `result.json`. Raises OutputError, naming folder and cause.
    """
    with result_folder(out, SET_RECORD, FRAME_RECORD) as staging:
        figures = {
            frame.name: _write_frame(frame, canonical, make_folder(staging / frame.name))
            for frame, canonical in zip(done.frames, done.result.frames, strict=True)
        }
        _write_set(done, staging)
    return figures


def _write_frame(frame: GlassesFrame, canonical: CanonicalEyeglasses, folder: Path) -> dict[str, Any]:
    written = write_frame_glb(folder / "canonical.glb", canonical)
    write_canonical(folder / "canonical.npz", canonical)
    write_keypoints(folder / "keypoints.json", canonical.keypoints, unit="mm")
    figures = frame_figures(frame, canonical, written)
    files = sorted(path.name for path in folder.iterdir())
    record = CanonicalFrameRecord(
        scan2albedo_version=VERSION,
        versions=installed_versions(),
        name=frame.name,
        input=InputRecord(
            file=str(frame.mesh_file),
            sha256=frame.mesh_sha256,
            vertices=len(frame.scan.vertices),
            faces=len(frame.scan.faces),
            texture_size=None,
        ),
        keypoints_file=str(frame.keypoints_file),
        keypoints_sha256=frame.keypoints_sha256,
        mm_per_unit=frame.mm_per_unit,
        scale=canonical.scale,
        canonical_from_frame=plain_json(canonical.canonical_from_frame),
        mode="unbend" if canonical.unbent else "mean",
        converged=canonical.converged,
        missing_key_points=frame.missing_key_points,
        plan=tuple(canonical.plan),
        metrics=figures,
        notes=frame.scan.notes,
        files=(*files, FRAME_RECORD),
    )
    write_record(folder / FRAME_RECORD, record)
    return figures


def frame_figures(
    frame: GlassesFrame, canonical: CanonicalEyeglasses, written: SkinWritten
) -> dict[str, Any]:
    """Return how bent a frame was, and what the GLB's cut to four joints a vertex costs."""
    rigid = transform_points(canonical.canonical_from_frame, canonical.scale * frame.scan.vertices)
    moved = np.linalg.norm(canonical.vertices - rigid, axis=1)
    cut = skin(frame.scan.vertices, written.weights, canonical.handle_transforms) - canonical.vertices
    return {
        "key_point_residual_mm": canonical.residual,
        "moved_rms_mm": float(np.sqrt(np.mean(moved**2))),
        "moved_max_mm": float(moved.max()),
        "glb_weight_cut": written.cut,
        "glb_moved_max_mm": float(np.linalg.norm(cut, axis=1).max()),
    }


def _write_set(done: CanonicalFiles, folder: Path) -> None:
    result = done.result
    write_keypoints(folder / "mean_keypoints.json", result.mean_keypoints, unit="mm")
    result.trace.to_csv(folder / "trace.csv")
    result.trace.plot().savefig(folder / "error_vs_time.png", dpi=110)
    drawn = [
        DrawnFrame(f.name, f.scan.vertices, f.keypoints, c)
        for f, c in zip(done.frames, result.frames, strict=True)
    ]
    panels = glasses_panels(drawn)
    count = f"{len(drawn)} frame{'s' * (len(drawn) > 1)}"
    title = count if len(drawn) <= MOST_FRAMES else f"{MOST_FRAMES} of {count}"
    overview_figure(title, panels, CANONICAL_COLUMNS).savefig(folder / "overview.png")
    files = sorted(path.name for path in folder.iterdir() if path.is_file())
    record = CanonicalSetRecord(
        scan2albedo_version=VERSION,
        versions=installed_versions(),
        options=dict(done.options),
        frames=tuple(frame.name for frame in done.frames),
        failures=done.failures,
        notes=done.notes,
        converged=result.converged,
        iterations=result.iterations,
        seconds=done.seconds,
        plan=tuple(result.plan),
        files=(*files, SET_RECORD),
    )
    write_record(folder / SET_RECORD, record)
