"""Lenses in a registered frame, over a head, for one camera or more: the run, and its files."""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from scan2albedo import eyeglasses
from scan2albedo.core import RawScan
from scan2albedo.core.arrays import ArrayLike, Texts, finite_rows, norms, rms
from scan2albedo.errors import EyeglassesError, errors_of
from scan2albedo.eyeglasses import Camera, LensPictureOptions, Surface
from scan2albedo.eyeglasses.keypoints import checked_keypoints
from scan2albedo.eyeglasses.lenses.inserted_lenses import SIDES, without_glass
from scan2albedo.eyeglasses.lenses.lens_picture import Lenses
from scan2albedo.eyeglasses.lenses.rims import Gaps
from scan2albedo.eyeglasses.lenses.scenes import WHITE_SHOWN, soft_environment, white_exposure
from scan2albedo.eyeglasses.mean_keypoints import own_axes
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import face_normals
from scan2albedo.io.color import encode_srgb_bytes
from scan2albedo.io.glb import GlbPart, write_parts_glb
from scan2albedo.io.images import write_exr, write_png
from scan2albedo.io.records import (
    Count,
    Figures,
    Name,
    NonNegative,
    Number,
    OptionalNumber,
    OwnFileNames,
    Positive,
    PositiveCount,
    Record,
    Share,
)
from scan2albedo.io.result_records import InputRecord, RunRecord
from scan2albedo.io.run_folder import OwnFiles, RunFolder
from scan2albedo.report.eyeglasses_views import MOST_SHOWN
from scan2albedo.report.overview import Panel, overview_picture
from scan2albedo.runs.eyeglasses.inputs import FileRecord, GlassesInput

LightSource = Literal["given", "built-in", "none"]

_FRAME_ALBEDO = (0.05, 0.05, 0.06)
"""Of frames without colours."""
_SKIN_ROUGHNESS_RAD = 0.3
_SHOWN_OPACITY = 0.08
"""Of clear lenses in the GLB: nobody would find them otherwise."""


class LensRecord(Record):
    """One lens: what it is made of, and the rim it fills."""

    side: Literal["left", "right"] = Field(description="The wearer's.")
    dioptres: Number = Field(description="1/m; negative for the shortsighted.")
    tint_linear: tuple[Number, Number, Number]
    alpha: Share = Field(description="Share of the tint.")
    beta: Share = Field(description="Share of the reflection, at right angles.")
    fresnel: bool
    tinting: Literal["paint", "filter"]
    front_radius_mm: OptionalNumber = Field(description="Of the sphere that mirrors; null is a flat one.")
    center_mm: tuple[Number, Number, Number] = Field(description="Optical centre, in the world.")
    normal: tuple[Number, Number, Number] = Field(description="Of the lens plane, towards the viewer.")
    mean_radius_mm: Positive
    measured: Share = Field(description="Share of the outline met by rays; the rest is filled in.")
    gaps: Gaps = Field(description="How the rest was filled in.")
    deviation_mm: OptionalNumber = Field(None, description="Of the outline as masks refine it; null without.")


class LensViewRecord(Record):
    """One picture."""

    name: Name
    width: PositiveCount
    height: PositiveCount
    left_lens_pixels: Count
    right_lens_pixels: Count
    unknown_pixels: Count = Field(description="Of which the photograph does not show what a lens does.")
    seconds: NonNegative


class LensesRecord(RunRecord):
    """The content of `result.json`."""

    name: Name = Field(description="Name of the frame.")
    options: Figures = Field(description="Settings of the pictures.")
    input: InputRecord = Field(description="The frame.")
    keypoints: FileRecord | None
    mm_per_unit: Positive = Field(description="Of the frame's file.")
    head: InputRecord
    cameras: FileRecord
    pictures: tuple[FileRecord, ...] = ()
    masks: tuple[FileRecord, ...] = Field((), description="By which rims were refined.")
    environment: FileRecord | None = Field(None, description="null for the built-in one, or none.")
    light: LightSource = Field(description="Where the environment comes from.")
    exposure: Positive = Field(description="Factor on linear colours in the PNG files.")
    lenses: tuple[LensRecord, ...]
    views: tuple[LensViewRecord, ...] = Field(min_length=1)
    notes: Texts = ()
    files: OwnFileNames


_MADE = ("*_lenses.exr", "*_lenses.png", "*_unknown.png", "frame_with_lenses.glb", "overview.png")
FILES = OwnFiles("result.json", LensesRecord, _MADE, "scan2albedo glasses lenses")


@dataclass(frozen=True)
class LensView:
    """A view with lenses in it."""

    camera: Camera
    picture: eyeglasses.LensPicture
    seconds: float


@dataclass(frozen=True)
class RenderedLenses:
    """What `render_lenses` made."""

    views: tuple[LensView, ...]
    frame: Surface
    """Without glass of its own where a lens is."""
    environment: LightSource
    from_photographs: bool
    exposure: float
    """Factor on linear colours for previews: `white_exposure`, 1 for photographs."""

    @property
    def lenses(self) -> tuple[eyeglasses.InsertedLens, ...]:
        """The lenses, the same in all views."""
        return self.views[0].picture.lenses

    @property
    def notes(self) -> Texts:
        """Notes of all views; those that only some have name them. The last is on the exposure."""
        said: dict[str, list[str]] = {}
        for view in self.views:
            for note in view.picture.notes:
                said.setdefault(note, []).append(view.camera.name)
        everywhere = len(self.views)
        notes = [n if len(names) == everywhere else f"{', '.join(names)}: {n}" for n, names in said.items()]
        if not self.from_photographs:
            notes.append(
                f"pictures show linear colours times {self.exposure:.3g}: under this light a white plate "
                f"that faces as the frame does is {WHITE_SHOWN:g} of white, whichever views are chosen"
            )
        return tuple(notes)


def render_lenses(
    frame: Surface,
    keypoints: ArrayLike,
    lenses: Lenses,
    *,
    head: Surface,
    cameras: Sequence[Camera],
    pictures_linear: Sequence[ArrayLike] | None = None,
    environment_linear: ArrayLike | None = None,
    rim_masks: Sequence[tuple[ArrayLike, ArrayLike]] = (),
    options: LensPictureOptions = LensPictureOptions(),
    on_view: Callable[[LensView], None] | None = None,
) -> RenderedLenses:
    """Put lenses into a frame that sits on a head, and show them to one camera or more.

    Frame, key points (20, 3) and head are in one world, in mm. Lenses, photographs (one a camera),
    environment and masks are those of `insert_lenses`; drawn views without one get `soft_environment`.
    `on_view` is called with each view. Raises EyeglassesError as from `insert_lenses`, and when frame and
    head lie apart; ValueError when there is no camera, or not a picture of its shape for each.
    """
    if not cameras:
        raise ValueError("give a camera")
    if pictures_linear is not None and len(pictures_linear) != len(cameras):
        raise ValueError(f"there are {len(pictures_linear)} pictures for {len(cameras)} cameras")
    photographs = [None] * len(cameras) if pictures_linear is None else list(map(np.asarray, pictures_linear))
    for image, camera in zip(photographs, cameras, strict=True):
        if image is not None and image.shape != (*camera.shape, 3):
            raise ValueError(f"picture of {camera.name!r} is {image.shape}, expected {(*camera.shape, 3)}")
    marks = checked_keypoints("keypoints", keypoints)
    known = marks[finite_rows(marks)]
    if len(known):
        query = ClosestPointQuery(head.vertices, head.faces)
        hits = query.query(known)
        # No worn frame's: it is in another world, or another unit.
        if (apart := np.median(hits.distance)) > 150:
            said = f"the frame lies {apart:.0f} mm away from the head"
            raise EyeglassesError(f"{said}; give both in the same world, and their units")
        # As in relit pictures, the inside of an open face is not drawn: if it is wound alike, and outward.
        edges = head.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        out = ((known - hits.points) * face_normals(head.vertices, head.faces)[hits.face]).sum(1)
        oriented = pictures_linear is None and len(np.unique(edges, axis=0)) == len(edges)
        head = replace(head, one_sided=bool(oriented and np.median(out) > 0))
    kind: LightSource = "none" if environment_linear is None else "given"
    exposure = 1.0
    if pictures_linear is None:
        axes = own_axes(marks)
        if environment_linear is None:
            kind, environment_linear = "built-in", soft_environment(axes)
        exposure = white_exposure(np.asarray(environment_linear, float), axes[2])
    views = []
    for camera, photograph in zip(cameras, photographs, strict=True):
        begun = time.perf_counter()
        picture = eyeglasses.insert_lenses(
            frame,
            keypoints,
            lenses,
            surfaces=[head],
            camera=camera.matrix,
            shape=camera.shape if photograph is None else None,
            picture_linear=photograph,
            environment_linear=environment_linear,
            rim_masks=rim_masks,
            options=options,
        )
        views.append(LensView(camera, picture, time.perf_counter() - begun))
        if on_view is not None:
            on_view(views[-1])
    bare = without_glass(frame, views[0].picture.lenses, marks)[0]
    return RenderedLenses(tuple(views), bare, kind, pictures_linear is not None, exposure)


def surface_of(scan: RawScan, albedo: ArrayLike = (0.5, 0.5, 0.5), roughness_rad: float = 0.0) -> Surface:
    """Return a scan as a surface with its texture, its vertex colours, or the albedo given."""
    return Surface(
        scan.vertices,
        scan.faces,
        albedo if scan.vertex_color_linear is None else scan.vertex_color_linear,
        uv=scan.uv,
        texture_linear=None if scan.uv is None else scan.texture_linear,
        roughness_rad=roughness_rad,
    )


def run_lenses(
    source: GlassesInput, lenses: Lenses, options: LensPictureOptions, out: Path, say: Callable[[str], None]
) -> LensesRecord:
    """Render what was read, write the files into `out` and return their record.

    Raises EyeglassesError, naming the files, when lenses cannot be put in; OutputError when writing fails.
    """
    frame, head, files = source.frame, source.head, source.files
    assert head is not None
    for note in source.notes:
        say(note)

    def say_view(view: LensView) -> None:
        seen = (view.picture.lens >= 0).sum()
        say(f"{frame.name}: {view.camera.name} done in {view.seconds:.1f} s; {seen} pixels see a lens")

    how = "drawn" if source.pictures is None else "put into photographs"
    say(f"{frame.name}: lenses are {how} for {', '.join(camera.name for camera in source.cameras)}")
    marks = files.get("keypoints")
    with errors_of(f"{files['mesh'].file}{f' with {marks.file}' if marks else ''}", EyeglassesError):
        rendered = render_lenses(
            surface_of(frame.scan, _FRAME_ALBEDO),
            frame.keypoints,
            lenses,
            head=surface_of(head, roughness_rad=_SKIN_ROUGHNESS_RAD),
            cameras=source.cameras,
            pictures_linear=source.pictures,
            environment_linear=source.environment,
            rim_masks=source.rim_masks,
            options=options,
            on_view=say_view,
        )
    for note in rendered.notes:
        say(f"{frame.name}: {note}")
    records = []
    for lens in rendered.lenses:
        material, rim = asdict(lens.material), lens.rim
        material |= {
            "side": SIDES[lens.side],
            "tint_linear": _vector(lens.material.tint_linear),
            "center_mm": _vector(lens.optics.center),
            "normal": _vector(rim.normal),
            "mean_radius_mm": norms(rim.points - rim.center).mean(),
            "measured": rim.measured.mean(),
            "gaps": rim.gaps,
            "deviation_mm": None if rim.deviation is None else rms(rim.deviation),
        }
        records.append(LensRecord.model_validate(material))
    with RunFolder(out, FILES).publishing() as staging:
        panels = []
        for view in rendered.views:
            name, picture = view.camera.name, view.picture
            both = picture.image_linear, picture.without_lenses_linear
            shown, empty = (encode_srgb_bytes(rendered.exposure * linear) for linear in both)
            write_exr(staging.folder / f"{name}_lenses.exr", picture.image_linear)
            write_png(staging.folder / f"{name}_lenses.png", shown)
            if rendered.from_photographs:
                write_png(staging.folder / f"{name}_unknown.png", picture.unknown)
            panels += [Panel(f"{name}, without lenses", empty), Panel(f"{name}, with lenses", shown)]
        bare = rendered.frame
        colors = np.asarray(bare.albedo_linear if bare.texture_linear is None else bare.texture_linear)
        color = _vector(np.median(colors.reshape(-1, 3), axis=0))
        parts = [GlbPart("frame", bare.vertices, bare.faces, color)]
        for lens in rendered.lenses:
            opacity = min(max(1.0 - lens.material.transmission.mean(), _SHOWN_OPACITY), 1.0)
            color, name = _vector(lens.material.tint_linear), lens.name.replace(" ", "_")
            parts.append(GlbPart(name, lens.vertices, lens.faces, color, opacity, roughness=_SHOWN_OPACITY))
        write_parts_glb(staging.folder / "frame_with_lenses.glb", parts)
        powers = ", ".join(f"{lens.name} {lens.material.dioptres:+g} D" for lens in rendered.lenses)
        overview = overview_picture(f"{frame.name}: {powers}", panels[: 2 * MOST_SHOWN], 2)
        staging.picture("overview.png", overview)
        record = staging.write_record(
            name=frame.name,
            options=asdict(options),
            input=InputRecord.of(frame.scan, Path(files["mesh"].file), files["mesh"].sha256),
            keypoints=files.get("keypoints"),
            mm_per_unit=frame.mm_per_unit,
            head=InputRecord.of(head, Path(files["head"].file), files["head"].sha256),
            cameras=files["cameras"],
            pictures=tuple(file for what, file in files.items() if what.startswith("picture ")),
            masks=tuple(file for what, file in files.items() if what.startswith("mask ")),
            environment=files.get("environment"),
            light=rendered.environment,
            exposure=rendered.exposure,
            lenses=tuple(records),
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
    say(f"{frame.name}: files in {out}")
    return record


def _vector(values: ArrayLike) -> tuple[float, float, float]:
    return tuple(np.asarray(values, float).tolist())
