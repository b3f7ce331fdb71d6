"""A frame registered on a face: the run, and the files of the result."""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from scan2albedo import eyeglasses
from scan2albedo.core import Budget, BudgetLike, OnProgress, PlanStep
from scan2albedo.core.arrays import FloatArray, Texts, Values, attributes, norms, rms
from scan2albedo.errors import EyeglassesError, errors_of
from scan2albedo.eyeglasses import write_keypoints, write_labels
from scan2albedo.eyeglasses.frame_files import write_frame_glb
from scan2albedo.io.images import write_png
from scan2albedo.io.records import (
    CalledWith,
    Count,
    Figures,
    Matrix,
    Name,
    NonNegative,
    OptionalNumber,
    OwnFileNames,
    Positive,
    Record,
    Share,
    plain_json,
)
from scan2albedo.io.result_records import RunRecord
from scan2albedo.io.run_folder import OwnFiles, RunFolder
from scan2albedo.report.eyeglasses_views import MOST_SHOWN, registration_panels
from scan2albedo.report.overview import overview_picture
from scan2albedo.runs.eyeglasses.inputs import FileRecord, GlassesInput


class RegisteredViewRecord(Record):
    """How well a registered frame fits one picture."""

    camera: str
    labels: Count = Field(description="Key points labelled.")
    outliers: Count = Field(description="Labels farther off than three times their noise.")
    label_rms_px: OptionalNumber = Field(None, description="Of the labels that are not outliers.")
    mask: bool = Field(description="Whether there was one.")
    proposed: Count = Field(0, description="Key points that the picture shows and nobody labelled.")
    proposed_deviation_px: OptionalNumber = Field(
        None, description="Of these along an axis, median; each one's is in the plan."
    )
    outline_rms_px: OptionalNumber = Field(None, description="Where outline and mask can be compared.")
    iou: OptionalNumber = Field(
        None, description="Of the frame's mask and the given one; high values are no evidence in space."
    )
    visible_share: Share = Field(description="Vertices in the picture and not behind the head.")


class RegisteredFrameRecord(RunRecord):
    """The content of a registered frame's `result.json`."""

    name: Name = Field(description="Name of the frame.")
    options: CalledWith
    inputs: dict[str, FileRecord] = Field(description="By what they are: mesh, cameras, labels and others.")
    mm_per_unit: Positive = Field(description="Of the mesh's file.")
    world_from_glasses: Matrix = Field(
        description="Row-major 4x4 acting on column vectors: the frame in mm, as it was before it was bent, "
        "into the cameras' world; rigid."
    )
    converged: bool
    iterations: Count = Field(description="Evaluations of the objective.")
    seconds: NonNegative
    depth_observed: bool
    unobserved: Texts = Field(description="'depth', and key points that no picture tells.")
    views: tuple[RegisteredViewRecord, ...]
    plan: tuple[PlanStep, ...]
    metrics: Figures
    notes: Texts = Field(
        (), description="What reading decided, repaired and did not find, and the plan's doubts."
    )
    files: OwnFileNames


_MADE = ("registered.glb", "registered.npz", "keypoints.json", "trace.csv", "error_vs_time.png")
_SEEN = ("overview.png", "proposed_labels.json", "*_mask.png")
FILES = OwnFiles("result.json", RegisteredFrameRecord, _MADE + _SEEN, "scan2albedo glasses register")


def _rms(values: FloatArray) -> float | None:
    return rms(values) if len(values) else None


@dataclass(frozen=True)
class PlacedFrame:
    """What became of the files of a registration."""

    inputs: GlassesInput
    result: eyeglasses.RegisteredEyeglasses
    options: Mapping[str, Any]
    seconds: float

    @property
    def notes(self) -> Texts:
        """What reading said, what was done about lenses, and what a person should check."""
        plan, doubts = self.result.plan, set(self.result.plan.doubts())
        found = ("glasses.lenses", "glasses.proposed")
        rows = (step for step in plan if step in doubts or (step.ran and step.stage in found))
        return (*self.inputs.notes, *(step.text for step in rows))

    @property
    def views(self) -> tuple[RegisteredViewRecord, ...]:
        """Figures of each view."""
        result, labelled = self.result, ~np.isnan(self.result.label_errors_px)
        proposed = result.proposed_deviation_px
        return tuple(
            RegisteredViewRecord(
                camera=camera.name,
                labels=int(labelled[number].sum()),
                outliers=int((labelled[number] & ~result.inliers[number]).sum()),
                label_rms_px=_rms(result.label_errors_px[number][result.inliers[number]]),
                mask=self.inputs.masks[number] is not None,
                proposed=int(np.isfinite(px).sum()),
                proposed_deviation_px=np.nanmedian(px) if np.isfinite(px).any() else None,
                outline_rms_px=result.outline_rms_px[number],
                iou=result.iou[number],
                visible_share=result.visible[number].mean(),
            )
            for number, (camera, px) in enumerate(zip(self.inputs.cameras, proposed, strict=True))
        )

    def figures(self) -> Values:
        """Return the figures of the whole, as in `result.json`."""
        result, labelled = self.result, ~np.isnan(self.result.label_errors_px)
        return {
            "label_rms_px": _rms(result.label_errors_px[result.inliers]),
            "labels": labelled.sum(),
            "label_outliers": (labelled & ~result.inliers).sum(),
            "depth_deviation_mm": result.depth_deviation,
            "observed_share": result.observed.mean(),
            "observed_deviation_rms_mm": _rms(result.deviation[result.observed]),
            "bend_max_mm": norms(result.bend).max(),
            "evaluations": result.iterations,
            "seconds": self.seconds,
        }

    def summary(self) -> str:
        """Return one line on how well the frame is known."""
        figures = self.figures()
        known = figures["observed_deviation_rms_mm"]
        sure = "nothing is observed" if known is None else f"known to {known:.2f} mm rms"
        lost = ", ".join(self.result.unobserved)
        placed = f"{self.inputs.frame.name}: placed in {self.seconds:.1f} s"
        seen = f"{figures['observed_share']:.0%} of the vertices observed, {sure}"
        return f"{placed}; {seen}" + (f"; not observed: {lost}" if lost else "")


def register_frame(
    inputs: GlassesInput,
    *,
    bend: bool = True,
    budget: BudgetLike = None,
    on_progress: OnProgress = None,
) -> PlacedFrame:
    """Register a frame on a face as `register_on_face` does.

    Raises EyeglassesError, naming mesh and labels, when the files fix no pose or do not belong together.
    """
    begun, spend, frame = time.perf_counter(), Budget.of(budget), inputs.frame
    assert inputs.labels is not None
    names = " with ".join(inputs.files[part].file for part in ("mesh", "labels") if part in inputs.files)
    with errors_of(names, EyeglassesError):
        result = eyeglasses.register_on_face(
            (frame.scan.vertices, frame.scan.faces, frame.keypoints, frame.weights),
            inputs.labels,
            inputs.masks,
            np.stack([camera.matrix for camera in inputs.cameras]),
            spend,
            head=inputs.head,
            start=inputs.start,
            shapes=[camera.shape for camera in inputs.cameras],
            pictures=inputs.pictures,
            options=eyeglasses.FaceRegistrationOptions(bend=bend),
            on_progress=on_progress,
        )
    options = {"bend": bend, "budget_s": spend.seconds, "budget_evaluations": spend.evaluations}
    return PlacedFrame(inputs, result, options, time.perf_counter() - begun)


def write_registration_files(done: PlacedFrame, out: Path) -> Values:
    """Write a registered frame's files; return the figures of its `result.json`, or raise OutputError."""
    result, inputs = done.result, done.inputs
    assert inputs.labels is not None
    with RunFolder(out, FILES).publishing() as staging:
        folder = staging.folder
        _, weight_cut = write_frame_glb(folder / "registered.glb", result)
        eyeglasses.write_registered(folder / "registered.npz", result)
        write_keypoints(folder / "keypoints.json", result.keypoints, unit="mm")
        # What was found in pictures, as files that a person may correct and give back.
        if any(mask is not None for mask in result.proposed_masks):
            marks = np.where(np.isnan(inputs.labels), result.proposed_labels, inputs.labels)
            write_labels(folder / "proposed_labels.json", marks, [camera.name for camera in inputs.cameras])
            for camera, mask in zip(inputs.cameras, result.proposed_masks, strict=True):
                if mask is not None:
                    write_png(folder / f"{camera.name}_mask.png", mask)
        staging.trace(result.trace)
        pairs = zip(inputs.masks, result.proposed_masks, strict=True)
        masks = [proposed if mask is None else mask for mask, proposed in pairs]
        views = list(zip(inputs.cameras, masks, inputs.labels, strict=True))
        title = f"{done.summary()}\norange: its outline, blue: behind the head; dots: labels, red: outliers"
        if len(views) > MOST_SHOWN:
            title += f"; {MOST_SHOWN} of {len(views)} views"
        mesh = None if inputs.head is None else (inputs.head.vertices, inputs.head.faces)
        panels = registration_panels(result, views, mesh)
        staging.picture("overview.png", overview_picture(title, panels, 3, 520))
        figures = {**done.figures(), "glb_weight_cut": weight_cut}
        staging.write_record(
            name=inputs.frame.name,
            options=dict(done.options),
            inputs=dict(inputs.files),
            mm_per_unit=inputs.frame.mm_per_unit,
            world_from_glasses=plain_json(result.world_from_glasses),
            **attributes(result, "converged", "iterations", "depth_observed", "unobserved"),
            **attributes(done, "seconds", "views", "notes"),
            plan=result.plan.steps,
            metrics=figures,
        )
    return figures
