"""`process_sequence`: the frames of one take, the same vertices throughout."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from scan2albedo.core import Budget, Meter, Plan, PlanStep, ProgressCallback, RawScan
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.core.first_run import compiled_beside
from scan2albedo.core.raw_scan import is_folder_name
from scan2albedo.errors import FitError, RegistrationError, Scan2AlbedoError, one_line
from scan2albedo.fitting.tracking import FaceTracker, TrackedFace, smoothed_in_time
from scan2albedo.geometry.mesh import vertex_normals
from scan2albedo.geometry.rasterization import filled_from_nearest
from scan2albedo.geometry.rigid import invert_rigid
from scan2albedo.io.atomic import check_writable
from scan2albedo.io.glb import write_glb
from scan2albedo.io.load_scan import load_scan_with
from scan2albedo.io.npz import write_npz
from scan2albedo.io.result_records import InputRecord, ResultRecord
from scan2albedo.io.run_folder import OwnFiles, RunFolder
from scan2albedo.pipeline.options import ProcessOptions
from scan2albedo.pipeline.process import WHOLE_FACE, process
from scan2albedo.pipeline.result import SURE, ProcessResult
from scan2albedo.pipeline.scale_search import registered_outward
from scan2albedo.registration import register
from scan2albedo.report.overview import preview_srgb

SEQUENCE_FILES = OwnFiles("sequence.json", ResultRecord, ("sequence.glb", "frames.npz"), whole_folder=True)
"""Every file that a sequence may have."""


@dataclass(frozen=True)
class SequenceResult:
    """A take: T frames of one face with the same vertices, smooth in time."""

    name: str
    control_points: FloatArray
    model_from_scan: FloatArray
    """`control_points` (T, C, 3) in the model's frame, mm, and the pose `model_from_scan` (T, 4, 4)."""
    frames: tuple[Mapping[str, Any], ...]
    """Of each frame its `file`; whether it was `used`, and `found_again` by a new registration; `cpu_s`;
    `residual_mm` and `coverage` of its fit, None without one; `deviation_mm`, the standard deviation of a
    point by the fits' noise and the prior of motion, None where unknown; `model_from_scan`; `notes`."""
    first: ProcessResult
    plan: Plan
    """The `first` frame that could be used, by the normal path; its `plan` and that of the take `name`."""
    converged: bool
    """False when the budget ended before the last frame."""
    out: Path | None = None
    """Folder with the files, when they were written."""

    @property
    def notes(self) -> tuple[str, ...]:
        """What loading decided and repaired, and what is doubtful or wrong, one sentence each."""
        return (*self.first.scan.notes, *(step.text for step in self.plan.doubts()))

    @property
    def left_out(self) -> tuple[tuple[str, str], ...]:
        """Files of frames that were left out, and why."""
        return tuple((frame["file"], frame["notes"][0]) for frame in self.frames if not frame["used"])

    def metrics(self) -> dict[str, Any]:
        """Return the figures of the frames."""
        return {"converged": self.converged, "frames": [dict(frame) for frame in self.frames]}

    def summary(self) -> str:
        """Return a summary of one line for a person."""
        used = [frame for frame in self.frames if frame["used"]]
        cpu_s, again = (sum(frame[name] for frame in self.frames) for name in ("cpu_s", "found_again"))
        line = (
            f"{self.name}: followed through {len(used)} of {len(self.frames)} frames in {cpu_s:.1f} s of CPU"
        )
        line += f"; fit {np.mean([frame['residual_mm'] for frame in used]):.2f} mm mean; {again} found again"
        line += "" if self.converged else "; the budget ended before the last frame"
        return line if self.out is None else f"{line}; files in {self.out}"

    def vertices(self, frame: int) -> FloatArray:
        """Return (V, 3) vertices of a frame, mm in the model's frame, with the faces of ``first.fitted``.

        Parameters
        ----------
        frame : int
            From 0.
        """
        fitted = self.first.fitted
        assert fitted is not None
        return np.asarray(fitted.model.subdivision(fitted.levels).matrix @ self.control_points[frame])


def process_sequence(
    frames: Sequence[str | Path | RawScan],
    out: str | Path | None = None,
    *,
    name: str,
    fps: float = 30.0,
    first: ProcessResult | None = None,
    on_progress: ProgressCallback | None = None,
    **options: Any,
) -> SequenceResult:
    """Return the frames of one take of one face, in order, as one mesh that moves.

    The first frame is registered and fitted as `process` does, each other from the last (`FaceTracker`). One
    to which the last pose does not lead, by the odds of a face there, is registered anew; one that cannot be
    read or used is left out by name. Then shape and pose are smoothed in time (`smoothed_in_time`); the same
    prior fills in what a frame does not show, and frames left out, and says how sure that is.

    Raises Scan2AlbedoError when no frame can be used, OutputError when the folder cannot be written;
    ValueError for no frames, a wrong name or `fps`, and what `ProcessOptions` refuses.

    Parameters
    ----------
    frames : sequence of path or RawScan
        Of one scanner, whose frame and unit are those of the first.
    out : path, optional
        Folder that gets a subfolder `name` with sequence.glb (morph targets and head motion, animated),
        frames.npz and sequence.json.
    name : str
    fps : float
        Frames a second in sequence.glb.
    first : ProcessResult, optional
        Of the first frame, when it was processed already; sequence.glb shows its albedo.
    on_progress : callable, optional
        Called with every `TraceRow`, one a frame after the first's.
    **options
        Those of `process`; when omitted, quality is "draft" and "albedo" skipped. A budget is seconds for the
        take: when they end the frames so far are returned with ``converged=False``.
    """
    if isinstance(frames, str | Path) or len(frames) == 0:
        raise ValueError("process_sequence: frames is empty or one path, expected a list of the take's scans")
    if not is_folder_name(name):
        raise ValueError(f"name is {name!r}, expected a name that a folder can have")
    if not 0 < fps < np.inf:
        raise ValueError(f"fps is {fps}, expected frames a second, above 0")
    chosen = ProcessOptions(**{"quality": "draft", "skip": ("albedo",), **options})
    if chosen.model == "none" or (first is not None and first.fitted is None):
        raise ValueError("a sequence needs a model, which is fitted to every frame, and model is 'none'")
    folder = RunFolder(Path(out or "") / name, SEQUENCE_FILES)
    if out is not None:
        folder.check()
        check_writable(Path(out))
    meter = Meter("sequence", "mm", Budget(Budget.of(chosen.budget).seconds), on_progress)
    found, rows, steps = list[TrackedFace](), list[dict[str, Any]](), list[PlanStep]()
    tracker: FaceTracker | None = None
    with compiled_beside():
        for number, source in enumerate(frames):
            if tracker is not None and meter.out_of_time:
                missing = f"frames {number + 1} to {len(frames)} are left out"
                steps.append(PlanStep.wrong("sequence.budget", f"{missing}: the budget ended before them"))
                break
            called, begin = source.name if isinstance(source, RawScan) else str(source), time.process_time()
            face, again, notes = None, False, list[str]()
            try:
                if tracker is None or first is None:
                    given = chosen.arguments()
                    first = first or process(source, name=name, on_progress=on_progress, **given)
                    assert first.fitted is not None
                    tracker = FaceTracker(first.fitted, chosen.stages.fit)
                    face = tracker.start
                else:
                    face, again = followed(source, first, tracker, found[-1], chosen)
            except Scan2AlbedoError as error:
                if tracker is None and number + 1 == len(frames):
                    raise
                notes.append(f"left out, and filled in from the frames around it: {one_line(error)}")
            if again:
                notes.append("the face was lost, and found again by a new registration")
            row = {"file": called, "used": face is not None, "found_again": again}
            row |= {name: getattr(face, name, None) for name in ("residual_mm", "coverage")}
            row["cpu_s"] = time.process_time() - begin
            if face is not None:
                if face.coverage < WHOLE_FACE:
                    near = f"only {100 * face.coverage:.0f} % of the face has scan near it"
                    notes.append(f"{near}, the rest is filled in from the frames around")
                found.append(face)
                meter.count()
                meter.record(face.residual_mm)
            told = f"frame {number + 1}, {called}: "
            steps += [PlanStep.doubt("sequence.frame", told + note) for note in notes]
            rows.append({**row, "notes": tuple(notes)})
    assert first is not None
    used = np.array([row["used"] for row in rows])
    control, poses, deviation = smoothed_take(found, used)
    for row, sd, pose in zip(rows, deviation, poses, strict=True):
        row |= {"deviation_mm": float(sd) if np.isfinite(sd) else None, "model_from_scan": pose.tolist()}
    reason = "shape and pose are smooth in time, by the noise and the motion that the frames show"
    moved = np.sqrt(np.mean(np.sum((control[used] - [face.control_points for face in found]) ** 2, axis=2)))
    steps.append(PlanStep("sequence.smoothing", True, reason, f"points moved by {moved:.2f} mm (RMS)"))
    reason = "nor proportions, openings, covers or painted features: a frame goes on from the last"
    steps.append(PlanStep("sequence.coarse_search", False, reason))
    plan, ended = Plan((*first.plan, *steps)), len(rows) == len(frames)
    result = SequenceResult(name, control, poses, tuple(rows), first, plan, ended)
    if out is None:
        return result
    with folder.publishing() as staging:
        written = write_take(staging.folder, result, fps)
        staging.write_record(
            name=name,
            seed=chosen.seed,
            options=dict(first.options),
            input=InputRecord.of(first.scan, first.source, first.input_sha256),
            plan=tuple(plan),
            metrics=result.metrics() | written,
            parameters={},
            timings_s=dict(first.timings_s),
            notes=result.notes,
        )
    return replace(result, out=folder.path)


def followed(
    source: str | Path | RawScan,
    first: ProcessResult,
    tracker: FaceTracker,
    last: TrackedFace,
    options: ProcessOptions,
) -> tuple[TrackedFace, bool]:
    """Return the face in a frame, and whether it had to be registered anew."""
    scan, face, mm = source, None, first.scan.mm_per_unit
    if not isinstance(scan, RawScan):
        scan = load_scan_with(scan, lambda mesh, parts: (mm, f"unit: 1 unit is {mm:.4g} mm, as in the first"))
    with suppress(FitError):  # nothing is near the last pose
        face = tracker.follow(scan, last)
    if face is not None and face.odds > 0:
        return face, False
    assert first.fitted is not None
    model, stage = first.fitted.model, options.of_registration()
    scan, pose = registered_outward(scan, partial(register, model=model, seed=options.seed, options=stage))
    if pose.confidence < SURE:
        raise RegistrationError(
            f"{scan.name}: no face where the last frame had it, and none elsewhere beyond doubt (confidence "
            f"{pose.confidence:.2f}); look at the scan"
        )
    anew = tracker.follow(scan, replace(last, model_from_scan=pose.model_from_scan))
    if face is not None and face.odds > anew.odds:
        return face, False
    # The shape is that of before the gap: once more, from nearer.
    return replace(tracker.follow(scan, anew), odds=anew.odds), True


def smoothed_take(found: list[TrackedFace], used: BoolArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return control points (T, C, 3), poses (T, 4, 4) and deviations (T,) mm of all frames, smooth in time.

    The shape is smoothed by its principal components. Points that a frame does not show are missing data of a
    Gaussian: filled in by the posterior mean, in rounds. Poses are turns about the first face and shifts.
    """
    shapes, seen = np.array([face.control_points for face in found]), np.array([face.seen for face in found])
    frames, hidden = np.flatnonzero(used), ~seen & seen.any(0)
    for point in np.flatnonzero(hidden.any(0)):
        there = seen[:, point]
        for curve in shapes[:, point].T:
            curve[~there] = np.interp(frames[~there], frames[there], curve[there])
    first, center = invert_rigid(found[0].model_from_scan), shapes.mean((0, 1))
    motion = np.array([face.model_from_scan @ first for face in found])
    turns = Rotation.from_matrix(motion[:, :3, :3]).as_rotvec()
    shifts = motion[:, :3, :3] @ center + motion[:, :3, 3] - center
    for _ in range(3):
        mean = shapes.mean(0)
        flat = (shapes - mean).reshape(len(shapes), -1)
        scores, size, components = np.linalg.svd(flat, full_matrices=False)
        measured = np.zeros((len(used), len(size) + 6))
        measured[used] = np.hstack([scores * size, turns, shifts])
        curves, spread = smoothed_in_time(measured, used)
        smooth = mean + (curves[:, :-6] @ components).reshape(-1, *mean.shape)
        shapes[hidden] = smooth[used][hidden]
    moved = np.tile(np.eye(4), (len(used), 1, 1))
    moved[:, :3, :3] = Rotation.from_rotvec(curves[:, -6:-3]).as_matrix()
    moved[:, :3, 3] = center + curves[:, -3:] - moved[:, :3, :3] @ center
    return smooth, moved @ invert_rigid(first), np.sqrt(3 * (spread[:, :-6] ** 2).sum(1) / mean.size)


def write_take(folder: Path, result: SequenceResult, fps: float) -> dict[str, Any]:
    """Write sequence.glb and frames.npz; return the number of morph targets, and how far they err, mm."""
    first, fitted, control = result.first, result.first.fitted, result.control_points
    assert fitted is not None
    moved = (control - control[0]).reshape(len(control), -1)
    scores, size, components = np.linalg.svd(moved, full_matrices=False)
    # As few as leave no point 0.05 mm off: those of the limit surface are means of control points.
    for count in range(len(size) + 1):
        left = moved - (scores[:, :count] * size[:count]) @ components[:count]
        error_mm = float(np.linalg.norm(left.reshape(control.shape), axis=2).max())
        if error_mm < 0.05:
            break
    # A weight of 1 is the farthest that a target goes.
    most = np.abs(scores[:, :count] * size[:count]).max(0)
    weights = scores[:, :count] * size[:count] / most
    shapes = (most[:, None] * components[:count]).reshape(count, *control.shape[1:])
    matrix, rest = fitted.model.subdivision(fitted.levels).matrix, result.vertices(0)
    turned, normals = np.zeros((count, *rest.shape)), vertex_normals(rest, fitted.faces)
    vertices, from_weights = np.empty((len(control), *rest.shape), np.float32), np.linalg.pinv(weights)
    for number in range(len(control)):
        vertices[number] = points = result.vertices(number)
        turned += from_weights[:, number, None, None] * (vertex_normals(points, fitted.faces) - normals)
    arrays = {"vertices_mm": vertices, "faces": fitted.faces, "uv": fitted.uv}
    arrays["model_from_scan"] = result.model_from_scan
    if fitted.landmarks is not None:
        arrays["landmarks_mm"] = np.array([fitted.model.landmarks_of(points) for points in control])
    write_npz(folder / "frames.npz", arrays, what="sequence")
    shown = None
    if first.albedo is not None:
        mask = first.geometry_image.mask
        shown = filled_from_nearest(preview_srgb(first.albedo.albedo_linear, mask), mask).astype(np.uint8)
    take = {
        "time_s": np.arange(len(control)) / fps,
        "targets": np.array([matrix @ target for target in shapes]).reshape(turned.shape),
        "normals": turned,
        "weights": weights,
        "pose": result.model_from_scan[0] @ np.linalg.inv(result.model_from_scan),
    }
    write_glb(folder / "sequence.glb", rest, fitted.faces, fitted.uv, shown, take=take)
    return {"fps": fps, "targets": count, "target_error_mm": error_mm}
