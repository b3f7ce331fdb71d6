"""The files of a frame registered on a face, all of them or none."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from scan2albedo.core.version import VERSION
from scan2albedo.eyeglasses import KEY_POINT_NAMES, write_keypoints, write_registered
from scan2albedo.eyeglasses.app.records import FileRecord, RegisteredFrameRecord, RegisteredViewRecord
from scan2albedo.eyeglasses.app.registration import PlacedFrame
from scan2albedo.eyeglasses.keypoints import PARENTS
from scan2albedo.io.records import installed_versions, plain_json, write_record
from scan2albedo.io.result_folder import result_folder
from scan2albedo.io.result_records import PlanRecord
from scan2albedo.io.skinned_glb import write_skinned_glb
from scan2albedo.report.eyeglasses_views import MOST_VIEWS, SeenView, registration_panels
from scan2albedo.report.overview import overview_figure

RECORD = "result.json"
"""Comes last: a folder that has one is whole."""
_COLUMNS = 3


def write_registration_files(done: PlacedFrame, out: Path) -> dict[str, Any]:
    """Write the files of a registered frame into `out`.

    They are made in a hidden folder and renamed into place, so that a run that is killed while they are
    made leaves older ones as they were.

    Returns
    -------
    dict
        Figures as in `result.json`.

    Raises
    ------
    OutputError
        Naming the folder and the cause.
    """
    with result_folder(out, RECORD) as staging:
        return _write_all(done, staging)


def _write_all(done: PlacedFrame, folder: Path) -> dict[str, Any]:
    result = done.result
    written = write_skinned_glb(
        folder / "registered.glb",
        result.vertices,
        result.faces,
        result.keypoints,
        result.weights,
        KEY_POINT_NAMES,
        parents=PARENTS,
    )
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
        plan=tuple(PlanRecord(**asdict(step)) for step in result.plan),
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
