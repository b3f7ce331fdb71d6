"""`process_sequence`: the frames of one take, the same vertices throughout."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from scan2albedo.core import OnProgress, Plan, PlanStep, RawScan
from scan2albedo.core.arrays import BoolArray, FloatArray, Values, identities, norms, rms
from scan2albedo.errors import FitError, RegistrationError
from scan2albedo.fitting.tracking import FaceTracker, TrackedFace, smoothed_in_time
from scan2albedo.geometry.rigid import invert_rigid
from scan2albedo.io.glb import write_glb
from scan2albedo.io.load_scan import load_scan_with
from scan2albedo.io.npz import write_npz
from scan2albedo.pipeline.options import ProcessOptions
from scan2albedo.pipeline.result import SURE, ProcessResult
from scan2albedo.pipeline.scale_search import registered_outward
from scan2albedo.pipeline.stages import WHOLE_FACE
from scan2albedo.pipeline.takes import Source, Takes
from scan2albedo.registration import register


@dataclass(frozen=True, kw_only=True)
class SequenceResult(ProcessResult):
    """A take: T frames of one face with the same vertices, smooth in time; else all is the first frame's."""

    control_points: FloatArray
    poses: FloatArray
    """`control_points` (T, C, 3) in the model's frame, mm, and the pose of each scan in it (T, 4, 4)."""
    frames: tuple[Mapping[str, Any], ...]
    """Of each frame its `file`; whether it was `used`, and `found_again` by a new registration; `cpu_s`;
    `residual_mm` and `coverage` of its fit, None without one; `deviation_mm`, the standard deviation of a
    point by the fits' noise and the prior of motion, None where unknown; `notes`."""
    fps: float
    """Frames a second."""

    @property
    def left_out(self) -> tuple[tuple[str, str], ...]:
        """Files of frames that were left out, and why."""
        return tuple((frame["file"], frame["notes"][0]) for frame in self.frames if not frame["used"])

    def metrics(self) -> Values:
        """Return the figures of the first frame, and those of all."""
        return {**super().metrics(), "fps": self.fps, "frames": [dict(frame) for frame in self.frames]}

    def summary(self) -> str:
        """Return a summary of one line for a person."""
        mm = [frame["residual_mm"] for frame in self.frames if frame["used"]]
        tracking = f"followed through {len(mm)} of {len(self.frames)} frames; fit {np.mean(mm):.2f} mm mean"
        return f"{super().summary()}; {tracking}"

    def vertices(self, frame: int) -> FloatArray:
        """Return (V, 3) vertices of a frame, mm in the model's frame, with the faces of ``fitted``."""
        assert self.fitted is not None
        return self.fitted.model.subdivision(self.fitted.levels).matrix @ self.control_points[frame]

    def write_more(self, folder: Path) -> None:
        """Write sequence.glb and frames.npz."""
        fitted, control = self.fitted, self.control_points
        assert fitted is not None
        moved = (control - control[0]).reshape(len(control), -1)
        scores, size, targets = np.linalg.svd(moved, full_matrices=False)
        # As few as leave no point 0.05 mm off: those of the limit surface are means of control points. A
        # weight of 1 is the farthest that a target goes.
        for count in range(len(size) + 1):
            left = moved - (scores[:, :count] * size[:count]) @ targets[:count]
            if norms(left.reshape(control.shape)).max() < 0.05:
                break
        most = np.abs(scores).max(0)
        shapes = ((most * size)[:, None] * targets)[:count].reshape(count, *control.shape[1:])
        matrix = fitted.model.subdivision(fitted.levels).matrix
        take = {
            "time_s": np.arange(len(control)) / self.fps,
            "targets": np.array([matrix @ shape for shape in shapes]),
            "weights": (scores / most)[:, :count],
            "pose": self.poses[0] @ np.linalg.inv(self.poses),
        }
        write_glb(
            folder / "sequence.glb", self.vertices(0), fitted.faces, fitted.uv, self.texture_srgb, take=take
        )
        arrays = {
            "vertices_mm": np.array([self.vertices(t).astype(np.float32) for t in range(len(control))]),
            "faces": fitted.faces,
            "uv": fitted.uv,
            "model_from_scan": self.poses,
            "landmarks_mm": np.array([fitted.model.landmarks_of(points) for points in control]),
        }
        write_npz(folder / "frames.npz", arrays, what="sequence")


def process_sequence(
    frames: Sequence[Source],
    out: str | Path | None = None,
    *,
    name: str,
    fps: float = 30.0,
    on_progress: OnProgress = None,
    **options: Any,
) -> SequenceResult:
    """Return the frames of one take of one face, in order, as one mesh that moves.

    The first frame is registered and fitted as `process` does, each other from the last (`FaceTracker`). One
    to which the last pose does not lead, by the odds of a face there, is registered anew; one that cannot be
    read or used is left out by name. Then shape and pose are smoothed in time (`smoothed_in_time`); the same
    prior fills in what a frame does not show, and frames left out, and says how sure that is. One scan at a
    time is in memory.

    Raises Scan2AlbedoError when no frame can be used, OutputError when the folder cannot be written;
    ValueError for no frames, a wrong name or `fps`, and what `ProcessOptions` refuses.

    Parameters
    ----------
    frames : sequence of path or RawScan
        Of one scanner, whose frame and unit are those of the first.
    out, name : path, str
        `out`, when given, gets a folder `name` with the files of the first frame's result, and sequence.glb
        (morph targets and head motion, animated) and frames.npz.
    fps : float
        Frames a second in sequence.glb.
    on_progress : callable, optional
        Called with every `TraceRow`.
    **options
        Those of `process`, whose budget holds for the first frame; draft without albedo when omitted.
    """
    if isinstance(frames, str | Path) or not len(frames):
        raise ValueError("frames is empty or a path, expected a list of the take's scans")
    if not 0 < fps < np.inf:
        raise ValueError(f"fps {fps}: expected frames a second above 0")
    chosen = ProcessOptions(**{"quality": "draft", "skip": ("albedo",), **options})
    takes = Takes(name, out, chosen, on_progress, timed=True)
    motion = _Motion(takes)
    rows = list[Values]()
    files = [source.name if isinstance(source, RawScan) else str(source) for source in frames]
    for take in takes.each(zip(files, frames, strict=True), motion.fit):
        face = take.fit
        if take.error is not None and not motion.faces and len(rows) + 1 == len(files):
            raise take.error
        notes = list[str]()
        if face is None:
            notes.append(f"left out, and filled in from the frames around it: {take.reason}")
        elif face.found_again:
            notes.append("the face was lost, and found again by a new registration")
        if face is not None and face.coverage < WHOLE_FACE:
            near = f"only {100 * face.coverage:.0f} % of the face has scan near it"
            notes.append(f"{near}, the rest is filled in from the frames around")
        takes.doubt("sequence.frame", f"frame {len(rows) + 1}, {take.name}", *notes)
        row = {
            "residual_mm": None if face is None else face.residual_mm,
            "coverage": None if face is None else face.coverage,
            "file": take.name,
            "found_again": face is not None and face.found_again,
            "used": face is not None,
            "cpu_s": take.cpu_s,
            "notes": tuple(notes),
        }
        rows.append(row)
    first = motion.first
    assert first is not None
    used = np.array([row["used"] for row in rows])
    control, poses, deviation = smoothed_take(motion.faces, used)
    for row, sd in zip(rows, deviation, strict=True):
        row["deviation_mm"] = float(sd) if np.isfinite(sd) else None
    moved = norms(control[used] - [face.control_points for face in motion.faces])
    reason = "frames go on from the last; smooth in time, by the noise and the motion that they show"
    step = PlanStep("sequence", True, reason, f"points moved by {rms(moved):.2f} mm (RMS)")
    plan = Plan((*first.plan, step, *takes.doubts))
    timings = {**first.timings_s, "frames": sum(row["cpu_s"] for row in rows[1:])}
    whole = vars(replace(first, plan=plan, timings_s=timings))
    result = SequenceResult(**whole, control_points=control, poses=poses, frames=tuple(rows), fps=fps)
    return result if takes.out is None else replace(result, out=takes.write(result, takes.out))


class _Motion:
    """The face from frame to frame: the `first` as `process` finds it, each other from the last."""

    def __init__(self, takes: Takes) -> None:
        self.takes = takes
        self.faces = list[TrackedFace]()
        self.first: ProcessResult | None = None

    def fit(self, name: str, source: Source) -> TrackedFace:
        """Return the face in the next frame."""
        takes = self.takes
        if self.first is None:
            first = takes.processed(source, takes.name)
            assert first.fitted is not None
            self.first = first
            self.tracker = FaceTracker(first.fitted, takes.options.stages.fit, takes.on_progress)
            face = self.tracker.start
        else:
            face = self._followed(source, self.first)
        self.faces.append(face)
        return face

    def _followed(self, source: Source, first: ProcessResult) -> TrackedFace:
        scan, mm = source, first.scan.mm_per_unit
        if not isinstance(scan, RawScan):
            unit = f"unit: 1 unit is {mm:.4g} mm, as in the first"
            scan = load_scan_with(scan, lambda mesh, parts: (mm, unit))
        tracker, last = self.tracker, self.faces[-1]
        with suppress(FitError):  # nothing is near the last pose
            face = tracker.follow(scan, last)
            if face.odds > 0:
                return face
        options = self.takes.options
        find = partial(register, model=self.takes.model, seed=options.seed, options=options.of_registration())
        scan, pose = registered_outward(scan, find)
        if pose.confidence < SURE:
            raise RegistrationError(
                f"{scan.name}: no face where the last frame had it, and none elsewhere beyond doubt "
                f"(confidence {pose.confidence:.2f}); look at the scan"
            )
        # The shape is that of before the gap: twice, the second time from nearer.
        near = tracker.follow(scan, replace(last, model_from_scan=pose.model_from_scan))
        return replace(tracker.follow(scan, near), found_again=True)


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
        scores, size, components = np.linalg.svd((shapes - mean).reshape(len(shapes), -1), False)
        measured = np.zeros((len(used), len(size) + 6))
        measured[used] = np.hstack([scores * size, turns, shifts])
        curves, spread = smoothed_in_time(measured, used)
        smooth = mean + (curves[:, :-6] @ components).reshape(-1, *mean.shape)
        shapes[hidden] = smooth[used][hidden]
    moved = identities(len(used), 4)
    moved[:, :3, :3] = Rotation.from_rotvec(curves[:, -6:-3]).as_matrix()
    moved[:, :3, 3] = center + curves[:, -3:] - moved[:, :3, :3] @ center
    return smooth, moved @ invert_rigid(first), np.sqrt(3 * (spread[:, :-6] ** 2).sum(1) / mean.size)
