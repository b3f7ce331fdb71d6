"""A frame registered on a face: the run, and the files of the result."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scan2albedo.core import Budget, ProgressCallback
from scan2albedo.core.version import VERSION
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses import (
    FaceRegistrationOptions,
    RegisteredEyeglasses,
    register_on_face,
    write_keypoints,
    write_registered,
)
from scan2albedo.eyeglasses.files.frame_files import write_frame_glb
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.io.atomic import result_folder
from scan2albedo.io.records import installed_versions, plain_json, write_record
from scan2albedo.report.eyeglasses_views import MOST_VIEWS, SeenView, registration_panels
from scan2albedo.report.overview import overview_figure
from scan2albedo.runs.eyeglasses.records import FileRecord, RegisteredFrameRecord, RegisteredViewRecord
from scan2albedo.runs.eyeglasses.registration_input import RegistrationInput

_APART_MM = 25.0
"""Distance of the nearest key point from the head beyond which nobody wears the frame."""
RECORD = "result.json"
"""Comes last: a folder that has one is whole."""
_COLUMNS = 3


@dataclass(frozen=True)
class PlacedFrame:
    """What became of the files of a registration."""

    given: RegistrationInput
    result: RegisteredEyeglasses
    options: Mapping[str, Any]
    seconds: float
    notes: tuple[str, ...]
    """Those of reading, and what looks wrong about the result."""

    def view_figures(self) -> list[dict[str, Any]]:
        """Return figures of each view, as in `result.json`."""
        return [self._of_view(number) for number in range(len(self.given.cameras))]

    def _of_view(self, number: int) -> dict[str, Any]:
        result, errors = self.result, self.result.label_errors_px[number]
        close = result.inliers[number]
        return {
            "camera": self.given.cameras[number].name,
            "labels": int((~np.isnan(errors)).sum()),
            "outliers": int((~np.isnan(errors) & ~close).sum()),
            "label_rms_px": float(np.sqrt(np.mean(errors[close] ** 2))) if close.any() else None,
            "mask": self.given.masks[number] is not None,
            "outline_rms_px": float(result.outline_rms_px[number]),
            "iou": float(result.iou[number]),
            "visible_share": float(result.visible[number].mean()),
        }

    def figures(self) -> dict[str, Any]:
        """Return the figures of the whole, as in `result.json`."""
        result, errors = self.result, self.result.label_errors_px
        close, sure = errors[result.inliers], result.deviation[result.observed]
        return {
            "label_rms_px": float(np.sqrt(np.mean(close**2))) if len(close) else None,
            "labels": int((~np.isnan(errors)).sum()),
            "label_outliers": int((~np.isnan(errors) & ~result.inliers).sum()),
            "depth_deviation_mm": result.depth_deviation,
            "observed_share": float(result.observed.mean()),
            "observed_deviation_rms_mm": float(np.sqrt(np.mean(sure**2))) if len(sure) else None,
            "bend_max_mm": float(np.linalg.norm(result.bend, axis=1).max()),
            "evaluations": result.iterations,
            "seconds": self.seconds,
        }

    def summary(self) -> str:
        """Return one line on how well the frame is known."""
        figures = self.figures()
        known = figures["observed_deviation_rms_mm"]
        sure = "nothing is observed" if known is None else f"known to {known:.2f} mm rms"
        text = (
            f"{self.given.name}: placed in {self.seconds:.1f} s; "
            f"{figures['observed_share']:.0%} of the vertices observed, {sure}"
        )
        lost = ", ".join(self.result.unobserved)
        return text + (f"; not observed: {lost}" if lost else "")


def register_frame(
    given: RegistrationInput,
    *,
    bend: bool = True,
    budget: Budget | float | None = None,
    on_progress: ProgressCallback | None = None,
) -> PlacedFrame:
    """Register a frame on a face as `register_on_face` does.

    Raises EyeglassesError, naming mesh and labels, when the files fix no pose or do not belong together.
    """
    begun, spend = time.perf_counter(), Budget.of(budget)
    try:
        result = register_on_face(
            given.frame,
            given.labels,
            given.masks,
            np.stack([camera.matrix for camera in given.cameras]),
            spend,
            head=given.head,
            start=given.start,
            shapes=[camera.shape for camera in given.cameras],
            options=FaceRegistrationOptions(bend=bend),
            on_progress=on_progress,
        )
    except EyeglassesError as error:
        names = " with ".join(str(given.hashes[part][0]) for part in ("mesh", "labels"))
        raise EyeglassesError(f"{names}: {error}") from error
    return PlacedFrame(
        given=given,
        result=result,
        options={
            "bend": bend,
            "budget_s": spend.seconds,
            "budget_evaluations": spend.evaluations,
        },
        seconds=time.perf_counter() - begun,
        notes=(*given.notes, *_warnings(given, result)),
    )


def _warnings(given: RegistrationInput, result: RegisteredEyeglasses) -> list[str]:
    """Return the signs that the inputs may not belong together."""
    notes = []
    if given.head is not None:
        marks = result.keypoints[np.isfinite(result.keypoints).all(1)]
        apart = float(ClosestPointQuery(given.head.vertices, given.head.faces).query(marks).distance.min())
        if apart > _APART_MM:
            notes.append(
                f"the head is {apart:.0f} mm or more from the frame: are head and cameras in one frame?"
            )
    for step in result.plan:
        if step.stage == "glasses.lenses" and (step.ran or step.evidence):
            notes.append(f"{step.reason} ({step.evidence})")
    if not result.converged:
        notes.append("not converged: the plan says which step, and a longer budget may end it")
    return notes


def write_registration_files(done: PlacedFrame, out: Path) -> dict[str, Any]:
    """Write a registered frame's files; return the figures of its `result.json`, or raise OutputError."""
    with result_folder(out, RECORD) as staging:
        return _write_all(done, staging)


def _write_all(done: PlacedFrame, folder: Path) -> dict[str, Any]:
    result = done.result
    written = write_frame_glb(folder / "registered.glb", result)
    write_registered(folder / "registered.npz", result)
    write_keypoints(folder / "keypoints.json", result.keypoints, unit="mm")
    result.trace.to_csv(folder / "trace.csv")
    result.trace.plot().savefig(folder / "error_vs_time.png", dpi=110)
    _write_overview(done, folder / "overview.png")
    figures = {**done.figures(), "glb_weight_cut": written.cut}
    files = sorted(path.name for path in folder.iterdir())
    record = RegisteredFrameRecord(
        scan2albedo_version=VERSION,
        versions=installed_versions(),
        name=done.given.name,
        options=dict(done.options),
        inputs={
            what: FileRecord(file=str(path), sha256=sha256)
            for what, (path, sha256) in done.given.hashes.items()
        },
        mm_per_unit=done.given.frame.mm_per_unit,
        world_from_glasses=plain_json(result.world_from_glasses),
        converged=result.converged,
        iterations=result.iterations,
        seconds=done.seconds,
        depth_observed=result.depth_observed,
        unobserved=result.unobserved,
        views=tuple(RegisteredViewRecord(**view) for view in done.view_figures()),
        plan=tuple(result.plan),
        metrics=figures,
        notes=done.notes,
        files=(*files, RECORD),
    )
    write_record(folder / RECORD, record)
    return figures


def _write_overview(done: PlacedFrame, path: Path) -> None:
    given, head = done.given, done.given.head
    views = [
        SeenView(camera, mask, labels)
        for camera, mask, labels in zip(given.cameras, given.masks, given.labels, strict=True)
    ]
    mesh = None if head is None else (head.vertices, head.faces)
    title = f"{done.summary()}\norange: its outline, blue: behind the head; dots: labels, red: outliers"
    if len(views) > MOST_VIEWS:
        title += f"; {MOST_VIEWS} of {len(views)} views"
    overview_figure(title, registration_panels(done.result, views, mesh), _COLUMNS).savefig(path, dpi=150)
