"""Lenses in a registered frame, over a head, for one camera or more: the run, and its files."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from scan2albedo.core.arrays import FloatArray
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses import (
    Camera,
    InsertedLens,
    LensMaterial,
    LensPicture,
    LensPictureOptions,
    Surface,
    insert_lenses,
)
from scan2albedo.eyeglasses.keypoints import checked_keypoints
from scan2albedo.eyeglasses.lenses.inserted_lenses import without_glass, worn_axes
from scan2albedo.eyeglasses.lenses.lens_picture import checked_image
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import normalized
from scan2albedo.io.glb import GlbPart, write_parts_glb
from scan2albedo.io.images import write_exr, write_png
from scan2albedo.io.records import Figures, Number, Record
from scan2albedo.io.result_records import InputRecord, RunRecord
from scan2albedo.io.run_folder import OwnFiles, RunFolder
from scan2albedo.lighting.environment import texel_directions, texel_solid_angles
from scan2albedo.report.eyeglasses_views import LENS_COLUMNS, lens_panels, preview
from scan2albedo.report.overview import overview_figure
from scan2albedo.runs.eyeglasses.inputs import FileRecord, GlassesInput

_LAMPS = (
    ((-0.6, 0.6, 0.7), 0.82, 7.0),
    ((0.9, 0.15, 0.6), 0.86, 1.6),
    ((0.15, 0.95, -0.45), 0.86, 3.0),
)
"""Direction (to the wearer's left, up, to the front), cosine of half the angle and radiance of each soft
lamp: key, fill, and one above the sitter."""
_SOFTNESS = 0.08
"""Cosines over which a lamp's edge fades."""
_WORN_MM = 150.0
"""Largest distance between a worn frame's rims and the head: more is another world, or another unit."""
WHITE_SHOWN = 0.9
"""Part of a preview's white as which a white plate that faces as the frame does is shown."""
_FRAME_ALBEDO, _HEAD_ALBEDO, _SKIN_ROUGHNESS_RAD = (0.05, 0.05, 0.06), (0.5, 0.5, 0.5), 0.3
"""Of frames and heads without colours."""
_SUN_TINT, _SUN_ALPHA, _TINT_ALPHA, _GLASS_BETA = (0.1, 0.07, 0.03), 0.85, 0.5, 0.04
"""Defaults of the command: of sunglasses, of tinted glass, and what glass of index 1.5 mirrors head-on."""
_SHOWN_ROUGHNESS, _SHOWN_OPACITY = 0.05, 0.08
"""Of lenses in the GLB: clear glass is shown a little, for nobody would find it."""


class LensRecord(Record):
    """One lens: what it is made of, and the rim it fills."""

    side: Literal["left", "right"] = Field(description="The wearer's.")
    dioptres: Number = Field(description="1/m; negative for the shortsighted.")
    tint_linear: tuple[Number, Number, Number]
    alpha: Number = Field(ge=0, le=1, description="Share of the tint.")
    beta: Number = Field(ge=0, le=1, description="Share of the reflection, at right angles.")
    fresnel: bool
    tinting: Literal["paint", "filter"]
    front_radius_mm: Number | None = Field(description="Of the sphere that mirrors; null is a flat one.")
    center_mm: tuple[Number, Number, Number] = Field(description="Optical centre, in the world.")
    normal: tuple[Number, Number, Number] = Field(description="Of the lens plane, towards the viewer.")
    mean_radius_mm: Number = Field(gt=0)
    measured: Number = Field(
        ge=0, le=1, description="Share of the outline met by rays; the rest is filled in."
    )
    gaps: Literal["none", "interpolated", "subdivided"] = Field(description="How the rest was filled in.")


class LensViewRecord(Record):
    """One picture."""

    name: str = Field(min_length=1)
    width: int = Field(ge=1)
    height: int = Field(ge=1)
    left_lens_pixels: int = Field(ge=0)
    right_lens_pixels: int = Field(ge=0)
    unknown_pixels: int = Field(ge=0, description="Of which the photograph does not show what a lens does.")
    seconds: Number = Field(ge=0)


class LensesRecord(RunRecord):
    """The content of `result.json`."""

    name: str = Field(min_length=1, description="Name of the frame.")
    options: Figures = Field(description="Settings of the pictures.")
    input: InputRecord = Field(description="The frame.")
    keypoints: FileRecord
    mm_per_unit: Number = Field(gt=0, description="Of the frame's file.")
    head: InputRecord
    cameras: FileRecord
    pictures: tuple[FileRecord, ...] = ()
    environment: FileRecord | None = Field(None, description="null for the built-in one, or none.")
    light: Literal["given", "built-in", "none"] = Field(description="Where the environment comes from.")
    exposure: Number = Field(gt=0, description="Factor on linear colours in the PNG files.")
    lenses: tuple[LensRecord, ...]
    views: tuple[LensViewRecord, ...] = Field(min_length=1)
    notes: tuple[str, ...] = ()
    files: tuple[str, ...] = Field(description="Names of the files beside this one.")


FILES = OwnFiles(
    "result.json",
    LensesRecord,
    ("*_lenses.exr", "*_lenses.png", "*_unknown.png", "frame_with_lenses.glb", "overview.png"),
    "scan2albedo glasses lenses",
)


def soft_environment(axes: ArrayLike, *, rows: int = 128) -> FloatArray:
    """Return a neutral map (rows, 2 rows, 3): an even room, brighter above, with three soft lamps.

    `axes` (3, 3) are those of `worn_axes`: lamps stand around whoever wears the frame, wherever a camera is,
    the main one on the wearer's right, which pictures show on the left.
    """
    seen = texel_directions((rows, 2 * rows)) @ np.asarray(axes, np.float64).T
    radiance = 0.4 + 0.2 * seen[..., 1]
    for direction, edge, strength in _LAMPS:
        rise = np.clip((seen @ normalized(np.array(direction)) - edge) / _SOFTNESS + 0.5, 0, 1)
        radiance = radiance + strength * rise * rise * (3 - 2 * rise)
    return np.repeat(radiance[..., None], 3, 2)


def white_exposure(environment_linear: FloatArray, front: FloatArray) -> float:
    """Return the factor that shows a matte white plate facing `front` (3,) as `WHITE_SHOWN` of white.

    Nothing hides the plate, so that an environment (H, W, 3) has one exposure for all cameras and heads.
    Where it gets less light than a plate does on average over all directions, that average counts; 1 in the
    dark.
    """
    rows, columns = environment_linear.shape[:2]
    light = environment_linear.mean(2) * texel_solid_angles(rows, columns)[:, None]
    facing = np.maximum(texel_directions((rows, columns)) @ front, 0.0)
    radiance = max(float((light * facing).sum()), float(light.sum()) / 4) / np.pi
    return WHITE_SHOWN / radiance if radiance > 0 else 1.0


@dataclass(frozen=True)
class LensView:
    """A view with lenses in it."""

    camera: Camera
    picture: LensPicture
    seconds: float


@dataclass(frozen=True)
class RenderedLenses:
    """What `render_lenses` made."""

    views: tuple[LensView, ...]
    frame: Surface
    """Without glass of its own where a lens is."""
    environment: Literal["given", "built-in", "none"]
    from_photographs: bool
    options: LensPictureOptions
    exposure: float
    """Factor on linear colours for previews, the same for all views: `white_exposure`, 1 for photographs."""

    @property
    def lenses(self) -> tuple[InsertedLens, ...]:
        """The lenses, the same in all views."""
        return self.views[0].picture.lenses

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes of all views; those that only some have name them. The last is on the exposure."""
        count = len(self.views)
        said: dict[str, list[str]] = {}
        for view in self.views:
            for note in view.picture.notes:
                said.setdefault(note, []).append(view.camera.name)
        notes = [n if len(names) == count else f"{', '.join(names)}: {n}" for n, names in said.items()]
        if not self.from_photographs:
            notes.append(
                f"pictures show linear colours times {self.exposure:.3g}: under this light a white plate "
                f"that faces as the frame does is {WHITE_SHOWN:g} of white, whichever views are chosen"
            )
        return tuple(notes)


def render_lenses(
    frame: Surface,
    keypoints: ArrayLike,
    lenses: LensMaterial | tuple[LensMaterial | None, LensMaterial | None],
    *,
    head: Surface,
    cameras: Sequence[Camera],
    pictures_linear: Sequence[ArrayLike] | None = None,
    environment_linear: ArrayLike | None = None,
    options: LensPictureOptions = LensPictureOptions(),
    on_view: Callable[[LensView], None] | None = None,
) -> RenderedLenses:
    """Put lenses into a frame that sits on a head, and show them to one camera or more.

    Frame, key points (20, 3) and head are in one world, in mm, such as ``Surface(registered.vertices,
    faces)`` of a `RegisteredEyeglasses`. Lenses, photographs (one a camera) and environment are those of
    `insert_lenses`; drawn views without an environment get `soft_environment`. `on_view` is called with each
    view when it is done. Raises EyeglassesError as from `insert_lenses`, and when frame and head lie apart;
    ValueError when there is no camera, or not a picture of its shape for each.
    """
    if not cameras:
        raise ValueError("give a camera")
    photographs: list[FloatArray | None] = [None] * len(cameras)
    if pictures_linear is not None:
        if len(pictures_linear) != len(cameras):
            raise ValueError(f"there are {len(pictures_linear)} pictures for {len(cameras)} cameras")
        photographs = [np.asarray(picture, np.float64) for picture in pictures_linear]
    for image, camera in zip(photographs, cameras, strict=True):
        if image is not None and image.shape != (*camera.shape, 3):
            raise ValueError(
                f"the picture of {camera.name!r} is {image.shape}, expected {(*camera.shape, 3)}"
            )
    marks = np.asarray(keypoints, np.float64)
    known = marks[np.isfinite(marks).all(1)] if marks.ndim == 2 else marks[:0]
    if len(known):
        query = ClosestPointQuery(np.asarray(head.vertices), np.asarray(head.faces))
        apart = float(np.median(query.query(known).distance))
        if apart > _WORN_MM:
            raise EyeglassesError(
                f"the frame lies {apart:.0f} mm away from the head; give both in the same world, and their "
                "units"
            )
    kind: Literal["given", "built-in", "none"] = "given"
    if environment_linear is None:
        kind = "none" if pictures_linear is not None else "built-in"
    exposure = 1.0
    if pictures_linear is None:
        axes = worn_axes(np.asarray(frame.vertices), checked_keypoints("keypoints", keypoints))
        if environment_linear is None:
            environment_linear = soft_environment(axes)
        exposure = white_exposure(checked_image("environment_linear", environment_linear), axes[2])
    views = []
    for camera, photograph in zip(cameras, photographs, strict=True):
        begun = time.perf_counter()
        picture = insert_lenses(
            frame,
            keypoints,
            lenses,
            surfaces=[head],
            camera=camera.matrix,
            shape=camera.shape if photograph is None else None,
            picture_linear=photograph,
            environment_linear=environment_linear,
            options=options,
        )
        views.append(LensView(camera, picture, time.perf_counter() - begun))
        if on_view is not None:
            on_view(views[-1])
    bare = without_glass(frame, views[0].picture.lenses, marks)[0]
    return RenderedLenses(tuple(views), bare, kind, pictures_linear is not None, options, exposure)


def surface_of(scan: RawScan, albedo: tuple[float, float, float], roughness_rad: float = 0.0) -> Surface:
    """Return a scan as a surface with its texture, its vertex colours, or the albedo given."""
    if scan.uv is not None and scan.texture_linear is not None:
        return Surface(
            scan.vertices,
            scan.faces,
            uv=scan.uv,
            texture_linear=scan.texture_linear,
            roughness_rad=roughness_rad,
        )
    colors = albedo if scan.vertex_color_linear is None else scan.vertex_color_linear
    return Surface(scan.vertices, scan.faces, colors, roughness_rad=roughness_rad)


def material_pair(
    dioptres: str,
    *,
    tint: str | None,
    alpha: float | None,
    beta: float | None,
    sunglasses: bool,
    fresnel: bool,
) -> tuple[LensMaterial, LensMaterial]:
    """Return the left and the right lens of the command's options.

    Raises ValueError when a text is not a number or holds too many or too few, EyeglassesError when one is
    out of range.
    """
    powers = _numbers("--dioptres", dioptres, (1, 2))
    color = (
        _numbers("--tint", tint, (3,)) if tint is not None else (_SUN_TINT if sunglasses else (0.0, 0.0, 0.0))
    )
    share = _SUN_ALPHA if sunglasses else (0.0 if tint is None else _TINT_ALPHA)
    mirrors = fresnel or sunglasses
    left, right = (
        LensMaterial(
            power,
            color,
            alpha=share if alpha is None else alpha,
            beta=(_GLASS_BETA if mirrors else 0.0) if beta is None else beta,
            fresnel=mirrors,
            tinting="filter" if sunglasses else "paint",
        )
        for power in (powers[0], powers[-1])
    )
    return left, right


def _numbers(name: str, text: str, counts: tuple[int, ...]) -> tuple[float, ...]:
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"{name} takes numbers with commas between them, got {text!r}") from None
    if len(values) not in counts:
        wanted = " or ".join(str(c) for c in counts)
        raise ValueError(f"{name} takes {wanted} numbers, got {len(values)} in {text!r}")
    return values


def run_lenses(
    source: GlassesInput,
    lenses: tuple[LensMaterial | None, LensMaterial | None],
    options: LensPictureOptions,
    out: Path,
    say: Callable[[str], None],
) -> LensesRecord:
    """Render what was read, write the files into `out` and return their record.

    Raises EyeglassesError, naming the files, when lenses cannot be put in; OutputError when writing fails.
    """
    name, files = source.frame.name, source.files
    for note in source.notes:
        say(note)

    def say_view(view: LensView) -> None:
        seen = int((view.picture.lens >= 0).sum())
        say(f"{name}: {view.camera.name} done in {view.seconds:.1f} s; {seen} pixels see a lens")

    how = "drawn" if source.pictures is None else "put into photographs"
    say(f"{name}: lenses are {how} for {', '.join(camera.name for camera in source.cameras)}")
    assert source.head is not None
    try:
        rendered = render_lenses(
            surface_of(source.frame.scan, _FRAME_ALBEDO),
            source.frame.keypoints,
            lenses,
            head=surface_of(source.head, _HEAD_ALBEDO, _SKIN_ROUGHNESS_RAD),
            cameras=source.cameras,
            pictures_linear=source.pictures,
            environment_linear=source.environment,
            options=options,
            on_view=say_view,
        )
    except EyeglassesError as error:
        raise EyeglassesError(f"{files['mesh'].file} with {files['keypoints'].file}: {error}") from error
    for note in rendered.notes:
        say(f"{name}: {note}")
    record = write_lens_files(rendered, source, out)
    say(f"{name}: files in {out}")
    return record


def write_lens_files(rendered: RenderedLenses, source: GlassesInput, out: Path) -> LensesRecord:
    """Write pictures, meshes and the record into `out`. Raises OutputError, naming folder and cause."""
    frame, files = source.frame, source.files
    assert source.head is not None
    with RunFolder(out, FILES).publishing() as staging:
        folder = staging.folder
        for view in rendered.views:
            name, picture = view.camera.name, view.picture
            write_exr(folder / f"{name}_lenses.exr", picture.image_linear)
            write_png(folder / f"{name}_lenses.png", preview(picture.image_linear, rendered.exposure))
            if rendered.from_photographs:
                write_png(folder / f"{name}_unknown.png", picture.unknown)
        bare = rendered.frame
        colors = np.asarray(bare.albedo_linear if bare.texture_linear is None else bare.texture_linear)
        color = _vector(np.median(colors.reshape(-1, 3), axis=0))
        parts = [GlbPart("frame", bare.vertices, bare.faces, color)]
        for lens in rendered.lenses:
            opacity = min(max(1.0 - float(lens.material.transmission.mean()), _SHOWN_OPACITY), 1.0)
            color, name = _vector(lens.material.tint_linear), lens.name.replace(" ", "_")
            parts.append(GlbPart(name, lens.vertices, lens.faces, color, opacity, _SHOWN_ROUGHNESS))
        write_parts_glb(folder / "frame_with_lenses.glb", parts)
        panels = lens_panels([(v.camera.name, v.picture) for v in rendered.views], rendered.exposure)
        powers = ", ".join(f"{lens.name} {lens.material.dioptres:+g} D" for lens in rendered.lenses)
        overview = overview_figure(f"{frame.name}: {powers}", panels, LENS_COLUMNS)
        staging.figure("overview.png", overview, dpi=100)
        return staging.write_record(
            name=frame.name,
            options=asdict(rendered.options),
            input=_input(frame.scan, files["mesh"]),
            keypoints=files["keypoints"],
            mm_per_unit=frame.mm_per_unit,
            head=_input(source.head, files["head"]),
            cameras=files["cameras"],
            pictures=tuple(file for what, file in files.items() if what.startswith("picture ")),
            environment=files.get("environment"),
            light=rendered.environment,
            exposure=rendered.exposure,
            lenses=tuple(_lens_record(lens) for lens in rendered.lenses),
            views=tuple(
                LensViewRecord(
                    name=view.camera.name,
                    width=view.camera.shape[1],
                    height=view.camera.shape[0],
                    left_lens_pixels=int((view.picture.lens == 0).sum()),
                    right_lens_pixels=int((view.picture.lens == 1).sum()),
                    unknown_pixels=int(view.picture.unknown.sum()),
                    seconds=view.seconds,
                )
                for view in rendered.views
            ),
            notes=(*source.notes, *rendered.notes),
        )


def _input(scan: RawScan, file: FileRecord) -> InputRecord:
    return InputRecord.of(scan, Path(file.file), file.sha256)


def _lens_record(lens: InsertedLens) -> LensRecord:
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
