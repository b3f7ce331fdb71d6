"""The commands for eyeglasses: thin wrappers around the library's calls."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from scan2albedo.cli import common
from scan2albedo.core.arrays import Values
from scan2albedo.errors import EyeglassesError, Scan2AlbedoError, one_line

if TYPE_CHECKING:
    from scan2albedo.cli.progress import ProgressLines

app = typer.Typer(help="Eyeglasses: canonical frames, frames on faces, lenses.", no_args_is_help=True)

UnitOption = Annotated[str, typer.Option(help="Of the meshes: auto, mm, cm or m.")]
KeyPointsOption = Annotated[
    Path | None, typer.Option(help="Of the frame; otherwise <mesh stem>.keypoints.json beside it.")
]
FrameWidthOption = Annotated[
    float | None,
    typer.Option(help="Width of the (first) frame's front in mm, as measured: sets the scale of all.", min=1),
]


@contextmanager
def _one_frame(
    frame: Path, stage: str, json_summary: bool = False, out: Path | None = None, files: Any = None
) -> Iterator[ProgressLines]:
    """Say progress, and end the command with one line, and JSON if wanted, on an error about the frame."""
    try:
        with common.working(stage, out, files) as progress:
            yield progress
    except Scan2AlbedoError as error:
        common.say(f"scan2albedo: error: {one_line(error)}")
        if json_summary:
            common.echo_json({"frame": str(frame), "status": "failed", "reason": one_line(error)})
        raise typer.Exit(common.USAGE_ERROR) from None


@app.command("key-points")
def key_points(
    frame: Annotated[
        Path | None, typer.Argument(help="A frame's mesh, whose key points are proposed.", metavar="[MESH]")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="PNG file for a labelled picture. Of a MESH: JSON file, with a picture beside "
            "it; <mesh stem>.keypoints.json beside the mesh when omitted.",
        ),
    ] = None,
    keypoints: Annotated[
        Path | None, typer.Option(help="Placed key points, which stay; only the others are proposed.")
    ] = None,
    unit: UnitOption = "auto",
) -> None:
    """Say where the 20 key points of a frame go, or propose those of MESH; with -o, show it in a picture."""
    from scan2albedo.io.atomic import atomic_path, check_writable
    from scan2albedo.report.eyeglasses_views import key_point_chart, key_point_table

    if frame is not None:
        from scan2albedo.runs.eyeglasses.inputs import write_proposed

        with _one_frame(frame, "glasses") as progress:
            write_proposed(frame, out, keypoints, unit, progress.say)
        return
    if out is not None:
        check_writable(out.parent)
    typer.echo(key_point_table())
    if out is not None:
        with atomic_path(out) as staging:
            key_point_chart().savefig(staging, format="png")


@app.command()
def canonicalize(
    meshes: Annotated[
        list[Path], typer.Argument(help="OBJ, PLY, GLB, STL or OFF files, one a frame.", metavar="MESH...")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the results, one subfolder a frame.")],
    keypoints: Annotated[
        list[Path] | None,
        typer.Option(
            help="Key points, once for each mesh, in order; otherwise <mesh stem>.keypoints.json beside it."
        ),
    ] = None,
    mean: Annotated[
        Path | None,
        typer.Option(help="mean_keypoints.json of an earlier set, to use in place of this set's mean."),
    ] = None,
    mode: Annotated[
        Literal["unbend", "mean"],
        typer.Option(
            help="unbend: take pose and bend away, keep each frame's own shape and sizes. mean: bring all "
            "key points to the mean's, with the proportions of the mean for all."
        ),
    ] = "unbend",
    handles: Annotated[
        Literal["turned", "translated"],
        typer.Option(
            help="For mode mean: turned, or translated: key points turn their surroundings or only shift it."
        ),
    ] = "turned",
    widths: Annotated[
        str, typer.Option(help="Least and greatest width of a front in mm; other frames are refused.")
    ] = "110,170",
    frame_width: FrameWidthOption = None,
    unit: UnitOption = "auto",
    budget: common.BudgetOption = None,
    json_summary: common.JsonOption = False,
) -> None:
    """Take pose and bend away from frames; shapes and sizes stay, or become the mean's with --mode mean.

    Where the key points go: `scan2albedo glasses key-points`.
    """
    common.refuse_shared_folders(meshes)
    if keypoints and len(keypoints) != len(meshes):
        raise typer.BadParameter(
            f"--keypoints is given {len(keypoints)} times for {len(meshes)} meshes; give it once for each"
        )
    from scan2albedo.eyeglasses import CanonicalizationOptions
    from scan2albedo.io.atomic import check_writable
    from scan2albedo.io.run_folder import RunFolder
    from scan2albedo.runs.eyeglasses.canonicalize_run import (
        FILES,
        FailedFrameRecord,
        canonicalize_frames,
        write_canonical_files,
    )
    from scan2albedo.runs.eyeglasses.inputs import GlassesFrame, numbers, read_frame

    if mode == "unbend" and handles != "turned":
        raise typer.BadParameter("--handles translated is for --mode mean")
    try:
        low, high = numbers("--widths", widths, 2)
        if not 0 < low < high:
            raise ValueError(f"--widths is {widths!r}, expected two lengths in mm such as 110,170")
    except ValueError as error:
        raise typer.BadParameter(one_line(error)) from None
    spend = common.checked_budget(budget, unit)
    figures: dict[str, Values] = {}
    with common.working("glasses", out) as progress:
        check_writable(out)
        RunFolder(out, FILES).check([mesh.stem for mesh in meshes])
        frames: list[GlassesFrame] = []
        failures: list[FailedFrameRecord] = []
        for number, mesh in enumerate(meshes):
            try:
                marks = None if keypoints is None else keypoints[number]
                if frame_width is None or number == 0:
                    scale: Values = {"frame_width_mm": frame_width}
                elif not frames:
                    raise EyeglassesError("its scale is that of the first frame, which failed")
                else:
                    scale = {"mm_per_unit": frames[0].mm_per_unit}
                frame = read_frame(mesh, marks, unit, (low, high), **scale)
            except Scan2AlbedoError as error:
                failures.append(FailedFrameRecord(file=str(mesh), reason=str(error)))
                continue
            frames.append(frame)
            for note in frame.scan.notes:
                progress.say(f"{frame.name}: {note}")
            if lost := frame.missing_key_points:
                progress.say(f"{frame.name}: without key points {', '.join(lost)}")
        try:
            done = canonicalize_frames(
                frames,
                failures,
                mean=mean,
                options=CanonicalizationOptions(mode=mode, handles=handles, widths_mm=(low, high)),
                budget=spend,
                on_progress=progress.update,
            )
            failures, figures = list(done.failures), write_canonical_files(done, out)
            for note in done.notes:
                progress.say(f"glasses: {note}")
            if not done.result.converged:
                progress.say("glasses: not converged; set.json says which frames, in its plan")
        except EyeglassesError as error:
            failures += [FailedFrameRecord(file=f.files["mesh"].file, reason=str(error)) for f in frames]
        for failure in failures:
            progress.say(f"scan2albedo: error: {failure.file}: {one_line(failure.reason)}")
        of = "the unbent frame's" if mode == "unbend" else "the mean's"
        for name, row in figures.items():
            bend = row["key_point_residual_mm"]
            progress.say(f"{name}: key points were {bend:.2f} mm rms off {of}; files in {out / name}")
    if json_summary:
        reasons = {failure.file: one_line(failure.reason) for failure in failures}
        rows: list[Values] = [
            {"frame": str(mesh), "status": "failed", "reason": reasons[str(mesh)]}
            if str(mesh) in reasons
            else {"frame": str(mesh), "status": "done", "out": str(out / mesh.stem), **figures[mesh.stem]}
            for mesh in meshes
        ]
        common.echo_json(rows if len(rows) > 1 else rows[0])
    if failures:
        raise typer.Exit(common.SOME_FAILED if figures else common.USAGE_ERROR)


@app.command()
def register(
    mesh: Annotated[
        Path, typer.Argument(help="OBJ, PLY, GLB, STL or OFF file, or a canonical.npz.", metavar="MESH")
    ],
    out: common.OutFolder,
    cameras: Annotated[Path, typer.Option(help="JSON file of the cameras.")],
    labels: Annotated[
        Path | None, typer.Option(help="JSON file of key points labelled in their pictures.")
    ] = None,
    pictures: Annotated[
        Path | None,
        typer.Option(
            help="Folder of photographs, <camera>.png or .jpg: what is not labelled is proposed from them."
        ),
    ] = None,
    masks: Annotated[
        Path | None, typer.Option(help="Folder of masks, <camera>.png: where a picture shows the frame.")
    ] = None,
    head: Annotated[
        Path | None,
        typer.Option(help="Mesh of what may hide the frame, in the cameras' frame, such as a fitted.glb."),
    ] = None,
    keypoints: KeyPointsOption = None,
    start: Annotated[
        Path | None, typer.Option(help="A pose, or an earlier registered.npz, where labels fix none.")
    ] = None,
    frame_width: FrameWidthOption = None,
    unit: UnitOption = "auto",
    rigid: Annotated[bool, typer.Option("--rigid", help="Move the frame without bending it.")] = False,
    budget: common.BudgetOption = None,
    json_summary: common.JsonOption = False,
) -> None:
    """Place a frame where calibrated pictures show it on a face, bent as they show it.

    Cameras and head share one frame. A fitted.glb lies in the frame of the face model: cameras that were
    calibrated with the scanner come into it by their matrices times the inverse of model_from_scan in the
    registration.json beside it.
    """
    from scan2albedo.runs.eyeglasses.inputs import CANONICAL, read_registration
    from scan2albedo.runs.eyeglasses.register_run import FILES, register_frame, write_registration_files

    spend = common.checked_budget(budget, unit)
    own = keypoints is not None or unit not in ("auto", "mm") or frame_width is not None
    if mesh.suffix.lower() == CANONICAL and own:
        raise typer.BadParameter(f"{mesh.name} brings its own key points and is in mm")
    with _one_frame(mesh, "glasses", json_summary, out, FILES) as progress:
        progress.say(f"glasses: reading {mesh}")
        more = {"pictures": pictures, "masks": masks, "head": head, "keypoints": keypoints, "start": start}
        inputs = read_registration(mesh, cameras, labels, **more, unit=unit, frame_width_mm=frame_width)
        done = register_frame(inputs, bend=not rigid, budget=spend, on_progress=progress.update)
        figures = write_registration_files(done, out)
        for note in done.notes:
            progress.say(f"{inputs.frame.name}: {note}")
        progress.say(f"{done.summary()}; files in {out}")
    if json_summary:
        views = [view.model_dump() for view in done.views]
        ended = {"converged": done.result.converged, "unobserved": done.result.unobserved, "views": views}
        common.echo_json({"frame": str(mesh), "status": "done", "out": str(out), **figures, **ended})


@app.command()
def demo(
    out: common.OutFolder = Path("glasses_out"),
    seed: Annotated[int, typer.Option(help="Of the person, the frame and the noise.", min=0)] = 0,
    json_summary: common.JsonOption = False,
) -> None:
    """Register a synthetic person's frame on their fitted face, print the error, put lenses in."""
    from scan2albedo.runs.eyeglasses.demo import run_glasses_demo

    with common.working("demo", out) as progress:
        report = run_glasses_demo(out, seed=seed, on_progress=progress.update, say=progress.say)
        progress.say(f"{report.placed.summary()}; files in {out}")
    if json_summary:
        common.echo_json(report.figures())
    else:
        typer.echo(report.table())


@app.command()
def lenses(
    frame: Annotated[
        Path, typer.Argument(help="The frame's mesh where it sits on the head.", metavar="FRAME")
    ],
    out: common.OutFolder,
    cameras: Annotated[Path, typer.Option(help="cameras.json.")],
    head: Annotated[Path, typer.Option(help="The head's mesh, in the same world.")],
    view: Annotated[
        list[str] | None, typer.Option(help="Name of a camera; may be repeated. All when omitted.")
    ] = None,
    keypoints: KeyPointsOption = None,
    picture: Annotated[
        list[Path] | None,
        typer.Option(help="Photograph to put the lenses into, once a view; otherwise the scene is drawn."),
    ] = None,
    masks: Annotated[
        Path | None,
        typer.Option(
            help="Folder of masks of the frame without lenses, <camera>.png, by which rims are refined: "
            "for meshes that have them only in part."
        ),
    ] = None,
    environment: Annotated[
        Path | None,
        typer.Option(
            help="Equirectangular EXR, HDR or PNG: light of a drawn scene, and what lenses mirror. When "
            "omitted, a drawn scene has the built-in light, and lenses in photographs mirror nothing."
        ),
    ] = None,
    dioptres: Annotated[str, typer.Option(help="D, or L,R: one number for both lenses or two.")] = "0",
    tint: Annotated[
        str | None, typer.Option(help="R,G,B, linear: the glass's colour; 0.1,0.07,0.03 with --sunglasses.")
    ] = None,
    alpha: Annotated[
        float | None,
        typer.Option(
            help="Share of the tint, 0 to 1. When omitted 0.5 with --tint, 0.85 with --sunglasses, else 0."
        ),
    ] = None,
    beta: Annotated[
        float | None,
        typer.Option(
            help="Share of the reflection, 0 to 1; alpha and beta together at most 1. When omitted 0.04 with "
            "--fresnel or --sunglasses, else 0."
        ),
    ] = None,
    sunglasses: Annotated[
        bool, typer.Option("--sunglasses", help="Dark glass that filters light, and mirrors like --fresnel.")
    ] = False,
    fresnel: Annotated[
        bool, typer.Option("--fresnel", help="Mirror, as glass does, and more towards glancing angles.")
    ] = False,
    supersampling: Annotated[int, typer.Option(help="n x n rays for pixels on edges.", min=1)] = 3,
    lights: Annotated[int, typer.Option(help="Distant lights for the environment.", min=1)] = 256,
    unit: UnitOption = "auto",
    json_summary: common.JsonOption = False,
) -> None:
    """Put lenses into a frame on a face and show them, drawn or in photographs.

    Drawn scenes without --environment have a built-in light: an even, neutral room with three soft lamps
    around the wearer, the main one on their right, one on their left, one above. Drawn pictures are exposed
    so that a white plate that faces as the frame does is 0.9 of white, the same for all views; the factor is
    printed. Photographs keep their own light and exposure. Lenses are clear window glass by default.
    """
    from scan2albedo.eyeglasses import LensPictureOptions
    from scan2albedo.io.units import check_unit
    from scan2albedo.runs.eyeglasses.inputs import material_pair, read_lens_scene
    from scan2albedo.runs.eyeglasses.lenses_run import FILES, run_lenses

    shares: Values = {"alpha": alpha, "beta": beta}
    files: Values = {"keypoints": keypoints, "views": view or (), "pictures": picture or ()}
    files |= {"masks": masks, "environment": environment}
    try:
        check_unit(unit)
        materials = material_pair(dioptres, tint=tint, **shares, sunglasses=sunglasses, fresnel=fresnel)
    except (ValueError, Scan2AlbedoError) as error:
        raise typer.BadParameter(one_line(error)) from None
    with _one_frame(frame, "lenses", json_summary, out, FILES) as progress:
        source = read_lens_scene(frame, head, cameras, **files, unit=unit)
        options = LensPictureOptions(supersampling=supersampling, light_count=lights)
        record = run_lenses(source, materials, options, out, progress.say)
    if json_summary:
        common.echo_json(
            {"frame": str(frame), "status": "done", "out": str(out), **record.model_dump(mode="json")}
        )
