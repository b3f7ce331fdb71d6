"""Frames of eyeglasses from files to canonical space, and the files of the result."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from scan2albedo import eyeglasses
from scan2albedo.core import Budget, BudgetLike, OnProgress, PlanStep
from scan2albedo.core.arrays import Texts, Values, attributes, norms, rms
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses import CanonicalizationOptions, skin, write_keypoints
from scan2albedo.eyeglasses.frame_files import read_keypoints_with_unit, write_frame_glb
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.io.records import (
    CalledWith,
    Count,
    Figures,
    Matrix,
    Name,
    NonNegative,
    OwnFileNames,
    Positive,
    Record,
    plain_json,
)
from scan2albedo.io.result_records import SHA256, InputRecord, RunRecord
from scan2albedo.io.run_folder import OwnFiles, RunFolder, Staging
from scan2albedo.io.units import MM_PER_UNIT
from scan2albedo.report.eyeglasses_views import MOST_SHOWN, glasses_panels
from scan2albedo.report.overview import overview_picture
from scan2albedo.runs.eyeglasses.inputs import GlassesFrame


class CanonicalFrameRecord(RunRecord):
    """The content of a canonical frame's `result.json`."""

    name: Name = Field(description="Name of the frame.")
    input: InputRecord
    keypoints_file: str | None = Field(description="Path as given; null when all were proposed.")
    keypoints_sha256: str | None = Field(pattern=SHA256)
    mm_per_unit: Positive = Field(description="Of the mesh's file.")
    scale: Positive = Field(description="Factor on the frame in mm; 1 unless it was of no true size.")
    canonical_from_frame: Matrix = Field(
        description="Row-major 4x4 acting on column vectors: the frame in mm, scaled, into canonical space; "
        "rigid. The bend is taken out after it, by the key points."
    )
    mode: Literal["unbend", "mean"] = Field(
        description="Whether the frame keeps its own shape and sizes, or its key points are the mean's."
    )
    converged: bool = Field(description="Whether the weights did.")
    missing_key_points: Texts = ()
    plan: tuple[PlanStep, ...]
    metrics: Figures
    notes: Texts = Field((), description="What loading decided and repaired.")
    files: OwnFileNames


class FailedFrameRecord(Record):
    """A frame that could not be done."""

    file: str = Field(description="Path as given.")
    reason: str


class CanonicalSetRecord(RunRecord):
    """The content of a set's `set.json`."""

    options: CalledWith
    frames: Texts = Field(description="Folders of the frames that were done.")
    failures: tuple[FailedFrameRecord, ...] = ()
    notes: Texts = Field((), description="The plan's doubts, and bends that stay.")
    converged: bool
    iterations: Count = Field(description="Rounds of the mean; 0 when it was given.")
    seconds: NonNegative
    plan: tuple[PlanStep, ...]
    files: OwnFileNames


_COMMAND = "scan2albedo glasses canonicalize"
_MADE = ("canonical.glb", "canonical.npz", "keypoints.json")
_FRAME_FILES = OwnFiles("result.json", CanonicalFrameRecord, _MADE, _COMMAND)
_SET_MADE = ("mean_keypoints.json", "trace.csv", "error_vs_time.png", "overview.png")
FILES = OwnFiles("set.json", CanonicalSetRecord, _SET_MADE, _COMMAND, inside=_FRAME_FILES)


@dataclass(frozen=True)
class CanonicalFiles:
    """What became of some mesh files; `frames` and `result.frames` go together."""

    frames: tuple[GlassesFrame, ...]
    result: eyeglasses.CanonicalSet
    failures: tuple[FailedFrameRecord, ...]
    options: Mapping[str, Any]
    seconds: float

    @property
    def notes(self) -> Texts:
        """What a person should check, and the bends that stay."""
        plan = self.result.plan
        return tuple(s.text for s in (*plan.doubts(), *plan.of_stage("eyeglasses.common_bend")))


def canonicalize_frames(
    frames: Sequence[GlassesFrame],
    failures: Sequence[FailedFrameRecord] = (),
    *,
    mean: Path | None = None,
    options: CanonicalizationOptions = CanonicalizationOptions(),
    budget: BudgetLike = None,
    on_progress: OnProgress = None,
) -> CanonicalFiles:
    """Take poses and bends away; frames go where their mean lies, or an earlier `mean_keypoints.json`.

    Adds to the `failures`. Raises EyeglassesError when no frame can be done, or `mean` cannot be read.
    """
    begun, spend, mean_mm = time.perf_counter(), Budget.of(budget), None
    if mean is not None:
        points, unit = read_keypoints_with_unit(mean)
        if unit == "unknown":
            raise EyeglassesError(f"key points {mean} do not say their unit; a mean needs one: mm, cm or m")
        mean_mm = points * MM_PER_UNIT[unit]
    result = eyeglasses.canonicalize(
        [frame.scan for frame in frames],
        [frame.keypoints for frame in frames],
        mean_keypoints=mean_mm,
        budget=spend,
        options=replace(options, skip_failed=True),
        on_progress=on_progress,
    )
    failed = ((frames[i].files["mesh"].file, reason) for i, reason in result.failures.items())
    lost = (FailedFrameRecord(file=file, reason=reason) for file, reason in failed)
    called = {name: value for name, value in asdict(options).items() if name != "skip_failed"}
    called |= {"mean": mean, "budget_s": spend.seconds, "budget_evaluations": spend.evaluations}
    done = tuple(frames[i] for i in result.numbers)
    return CanonicalFiles(done, result, (*failures, *lost), called, time.perf_counter() - begun)


def write_canonical_files(done: CanonicalFiles, out: Path) -> dict[str, Values]:
    """Write each frame's files into ``out / <name>`` and the set's into `out`; return figures by frame name.

    The figures are as in `result.json`. Raises OutputError, naming folder and cause.
    """
    result, figures = done.result, {}
    both = list(zip(done.frames, result.frames, strict=True))
    with RunFolder(out, FILES).publishing() as staging:
        for frame, canonical in both:
            folder = staging.folder / frame.name
            folder.mkdir()
            weights, weight_cut = write_frame_glb(folder / "canonical.glb", canonical)
            eyeglasses.write_canonical(folder / "canonical.npz", canonical)
            write_keypoints(folder / "keypoints.json", canonical.keypoints, unit="mm")
            # How bent the frame was, and what the GLB's cut to four joints a vertex costs.
            rigid = transform_points(canonical.canonical_from_frame, canonical.scale * frame.scan.vertices)
            moved = norms(canonical.vertices - rigid)
            cut = skin(frame.scan.vertices, weights, canonical.handle_transforms) - canonical.vertices
            figures[frame.name] = {
                "key_point_residual_mm": canonical.residual,
                "moved_rms_mm": rms(moved),
                "moved_max_mm": moved.max(),
                "glb_weight_cut": weight_cut,
                "glb_moved_max_mm": norms(cut).max(),
            }
            mesh, keypoints = frame.files["mesh"], frame.files.get("keypoints")
            Staging(folder, _FRAME_FILES).write_record(
                name=frame.name,
                input=InputRecord.of(frame.scan, Path(mesh.file), mesh.sha256),
                keypoints_file=keypoints and keypoints.file,
                keypoints_sha256=keypoints and keypoints.sha256,
                **attributes(frame, "mm_per_unit", "missing_key_points"),
                **attributes(canonical, "scale", "converged"),
                canonical_from_frame=plain_json(canonical.canonical_from_frame),
                mode="unbend" if canonical.unbent else "mean",
                plan=canonical.plan.steps,
                metrics=figures[frame.name],
                notes=frame.scan.notes,
            )
        write_keypoints(staging.folder / "mean_keypoints.json", result.mean_keypoints, unit="mm")
        staging.trace(result.trace)
        drawn = [(frame.name, frame.scan.vertices, canonical) for frame, canonical in both]
        title = f"{MOST_SHOWN} of " * (len(drawn) > MOST_SHOWN)
        title += f"{len(drawn)} frame{'s' * (len(drawn) > 1)}"
        staging.picture("overview.png", overview_picture(title, glasses_panels(drawn), 4))
        staging.write_record(
            options=dict(done.options),
            frames=tuple(frame.name for frame in done.frames),
            **attributes(done, "failures", "notes", "seconds"),
            **attributes(result, "converged", "iterations"),
            plan=result.plan.steps,
        )
    return figures
