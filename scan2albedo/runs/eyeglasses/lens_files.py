"""Lenses from read files to written ones."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from scan2albedo.core.version import VERSION
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses import InsertedLens, LensMaterial, LensPictureOptions, Surface
from scan2albedo.io.atomic import result_folder
from scan2albedo.io.glb import GlbPart, write_parts_glb
from scan2albedo.io.images import write_exr, write_png
from scan2albedo.io.records import installed_versions, listed_files, write_record
from scan2albedo.io.result_records import InputRecord
from scan2albedo.report.eyeglasses_views import LENS_COLUMNS, lens_panels, preview
from scan2albedo.report.overview import overview_figure
from scan2albedo.runs.eyeglasses.lens_input import LensInput
from scan2albedo.runs.eyeglasses.lenses_run import LensView, RenderedLenses, render_lenses
from scan2albedo.runs.eyeglasses.records import FileRecord, LensesRecord, LensRecord, LensViewRecord

RECORD = "result.json"
"""It comes last: a folder that has one is whole."""
_LENS_ROUGHNESS = 0.05
_LEAST_OPACITY = 0.08
"""Clear glass is shown a little, for nobody would find it."""


def write_lens_files(rendered: RenderedLenses, source: LensInput, out: Path) -> LensesRecord:
    """Write pictures, meshes and the record into `out`. Raises OutputError, naming folder and cause."""
    # An older run may have shown other views.
    with result_folder(out, RECORD, obsolete=listed_files(out / RECORD, LensesRecord)) as staging:
        return _write_all(rendered, source, staging)


def _write_all(rendered: RenderedLenses, source: LensInput, folder: Path) -> LensesRecord:
    for view in rendered.views:
        name, picture = view.camera.name, view.picture
        write_exr(folder / f"{name}_lenses.exr", picture.image_linear)
        write_png(folder / f"{name}_lenses.png", preview(picture.image_linear, rendered.exposure))
        if rendered.from_photographs:
            write_png(folder / f"{name}_unknown.png", picture.unknown)
    parts = [_frame_part(rendered.frame), *(_lens_part(lens) for lens in rendered.lenses)]
    write_parts_glb(folder / "frame_with_lenses.glb", parts)
    panels = lens_panels([(v.camera.name, v.picture) for v in rendered.views], rendered.exposure)
    powers = ", ".join(f"{lens.name} {lens.material.dioptres:+g} D" for lens in rendered.lenses)
    overview_figure(f"{source.frame.name}: {powers}", panels, LENS_COLUMNS).savefig(folder / "overview.png")
    files = sorted(path.name for path in folder.iterdir())
    record = _record(rendered, source, (*files, RECORD))
    write_record(folder / RECORD, record)
    return record


def _frame_part(frame: Surface) -> GlbPart:
    texture = frame.texture_linear
    colors = np.asarray(frame.albedo_linear if texture is None else texture).reshape(-1, 3)
    return GlbPart("frame", frame.vertices, frame.faces, _vector(np.median(colors, axis=0)))


def _lens_part(lens: InsertedLens) -> GlbPart:
    material = lens.material
    opacity = max(1.0 - float(material.transmission.mean()), _LEAST_OPACITY)
    name, color = lens.name.replace(" ", "_"), _vector(material.tint_linear)
    return GlbPart(name, lens.vertices, lens.faces, color, min(opacity, 1.0), _LENS_ROUGHNESS)


def _record(rendered: RenderedLenses, source: LensInput, files: tuple[str, ...]) -> LensesRecord:
    frame = source.frame
    environment = source.environment_file
    return LensesRecord(
        scan2albedo_version=VERSION,
        versions=installed_versions(),
        name=frame.name,
        options=asdict(rendered.options),
        input=InputRecord.of(frame.scan, frame.mesh_file, frame.mesh_sha256),
        keypoints=FileRecord(file=str(frame.keypoints_file), sha256=frame.keypoints_sha256),
        mm_per_unit=frame.mm_per_unit,
        head=InputRecord.of(source.head, source.head_file, source.hashes[source.head_file]),
        cameras=_file(source, source.cameras_file),
        pictures=tuple(_file(source, path) for path in source.picture_files),
        environment=None if environment is None else _file(source, environment),
        light=rendered.environment,
        exposure=rendered.exposure,
        lenses=tuple(_lens(lens) for lens in rendered.lenses),
        views=tuple(_view(view) for view in rendered.views),
        notes=(
            *(f"frame: {note}" for note in frame.scan.notes),
            *(f"head: {note}" for note in source.head.notes),
            *rendered.notes,
        ),
        files=files,
    )


def _file(source: LensInput, path: Path) -> FileRecord:
    return FileRecord(file=str(path), sha256=source.hashes[path])


def _lens(lens: InsertedLens) -> LensRecord:
    material, rim = lens.material, lens.rim
    return LensRecord(
        side="right" if lens.side == 1 else "left",
        dioptres=material.dioptres,
        tint_linear=_vector(material.tint_linear),
        alpha=material.alpha,
        beta=material.beta,
        fresnel=material.fresnel,
        tinting=material.tinting,
        front_radius_mm=material.front_radius_mm if math.isfinite(material.front_radius_mm) else None,
        center_mm=_vector(lens.optics.center),
        normal=_vector(rim.normal),
        mean_radius_mm=float(np.linalg.norm(rim.points - rim.center, axis=1).mean()),
        measured=float(rim.measured.mean()),
        gaps=rim.gaps,
    )


def _vector(values: Any) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in np.asarray(values))
    return x, y, z


def _view(view: LensView) -> LensViewRecord:
    height, width = view.camera.shape
    left, right = (int((view.picture.lens == side).sum()) for side in (0, 1))
    return LensViewRecord(
        name=view.camera.name,
        width=width,
        height=height,
        left_lens_pixels=left,
        right_lens_pixels=right,
        unknown_pixels=int(view.picture.unknown.sum()),
        seconds=view.seconds,
    )


def run_lenses(
    source: LensInput,
    lenses: tuple[LensMaterial | None, LensMaterial | None],
    options: LensPictureOptions,
    out: Path,
    say: Callable[[str], None],
) -> LensesRecord:
    """Render what was read, write the files into `out` and return their record.

    Raises EyeglassesError, naming the files, when lenses cannot be put in; OutputError when writing fails.
    """
    name = source.frame.name
    for what, notes in (("frame", source.frame.scan.notes), ("head", source.head.notes)):
        for note in notes:
            say(f"{what}: {note}")

    def say_view(view: LensView) -> None:
        seen = int((view.picture.lens >= 0).sum())
        say(f"{name}: {view.camera.name} done in {view.seconds:.1f} s; {seen} pixels see a lens")

    how = "drawn" if source.pictures is None else "put into photographs"
    say(f"{name}: lenses are {how} for {', '.join(camera.name for camera in source.cameras)}")
    try:
        rendered = render_lenses(
            source.frame_surface,
            source.frame.keypoints,
            lenses,
            head=source.head_surface,
            cameras=source.cameras,
            pictures_linear=source.pictures,
            environment_linear=source.environment,
            options=options,
            on_view=say_view,
        )
    except EyeglassesError as error:
        files = f"{source.frame.mesh_file} with {source.frame.keypoints_file}"
        raise EyeglassesError(f"{files}: {error}") from error
    for note in rendered.notes:
        say(f"{name}: {note}")
    record = write_lens_files(rendered, source, out)
    say(f"{name}: files in {out}")
    return record
