"""The commands for processed faces: relight, swap, blend, transfer-expression."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from scan2albedo.cli_tools import JsonOption, echo_json, stop_cleanly_on_interrupt

if TYPE_CHECKING:
    from scan2albedo.applications import ProcessedFace, RelitFace
    from scan2albedo.lighting import PointLight

LAMP_INTENSITY = 3.0
PICTURES, TEXTURED, ANIMATED = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".exr"), ".glb", ".gif"

Result = Annotated[Path, typer.Argument(help="Folder of a processed scan, OUT/<scan name>.")]
OutFolder = Annotated[Path, typer.Option("--out", "-o", help="Folder for the new face.")]


def add_commands(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    app.command()(relight)
    app.command()(swap)
    app.command()(blend)
    app.command("transfer-expression")(transfer_expression)


def relight(
    result: Result,
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            "-o",
            help="A picture (.png .jpg .tif .exr), the face (.glb), or with --sweep a .gif or folder.",
        ),
    ],
    light: Annotated[
        list[str] | None,
        typer.Option(
            help="AZ,EL[,INTENSITY[,DISTANCE_MM]] in degrees from the front toward the subject's left "
            "and up; intensity 3 when omitted, ambient light being 1; distant when omitted; may be repeated."
        ),
    ] = None,
    environment: Annotated[
        Path | None,
        typer.Option(help="Latitude-longitude picture that lights the face: .exr, .hdr or any other."),
    ] = None,
    ambient: Annotated[
        float | None, typer.Option(help="Light without direction; 1, or 0 with an environment.", min=0)
    ] = None,
    view: Annotated[str, typer.Option(help="AZ,EL of the camera in degrees.")] = "0,0",
    size: Annotated[int, typer.Option(help="Height and width of the picture.", min=8)] = 512,
    texture: Annotated[
        bool, typer.Option("--texture", help="Write the relit texture on its chart, not a picture.")
    ] = False,
    sweep: Annotated[
        int | None, typer.Option(help="So many frames, a light going around the face.", min=1)
    ] = None,
    exposure: Annotated[
        float | None, typer.Option(help="Factor of what 8-bit pictures show; by itself when omitted.")
    ] = None,
    json_summary: JsonOption = False,
) -> None:
    """Show a processed face under other light, with its shadows."""
    lights = [_light(text) for text in light or ()]
    camera_at = _angles("--view", view, 2, 2)
    extension = out.suffix.lower()
    _check_output(extension, sweep, texture)
    if not lights and environment is None and sweep is None:
        raise typer.BadParameter("there is no light; give --light, --environment or --sweep")
    if environment is not None and sweep is not None:
        raise typer.BadParameter("--sweep moves a lamp; leave out --environment")
    if exposure is not None and not (math.isfinite(exposure) and exposure > 0):
        raise typer.BadParameter(f"--exposure is {exposure}, expected a number above 0")
    from scan2albedo import applications
    from scan2albedo.io.images import read_image_linear

    stop_cleanly_on_interrupt(None)
    face = applications.load_result(result)
    azimuth, elevation = (math.radians(angle) for angle in camera_at)
    try:
        camera = applications.default_camera(face, (size, size), azimuth_rad=azimuth, elevation_rad=elevation)
    except ValueError as error:
        raise typer.BadParameter(f"--view {view}: {error}") from None
    if sweep is not None:
        _write_sweep(face, lights, sweep, ambient, camera, size, exposure, out)
    else:
        map_linear = None if environment is None else read_image_linear(environment)
        relit = applications.relight(face, lights, environment_linear=map_linear, ambient=ambient)
        _write_relit(relit, camera, size, texture, exposure, out)
    typer.echo(f"{face.name}: relit; {out}", err=True)
    if json_summary:
        echo_json({"face": face.name, "status": "done", "out": str(out), "lights": len(lights)})


def _check_output(extension: str, sweep: int | None, texture: bool) -> None:
    if sweep is not None:
        if extension not in (ANIMATED, ""):
            raise typer.BadParameter(f"--sweep writes a .gif or a folder of frames, not {extension}")
        if texture:
            raise typer.BadParameter("--sweep writes pictures; leave out --texture")
    elif extension not in (*PICTURES, TEXTURED):
        wanted = ", ".join((*PICTURES, TEXTURED))
        raise typer.BadParameter(f"-o takes {wanted}, not {extension or 'a name without extension'}")


def _write_sweep(
    face: ProcessedFace,
    others: list[PointLight],
    count: int,
    ambient: float | None,
    camera: Any,
    size: int,
    exposure: float | None,
    out: Path,
) -> None:
    from scan2albedo import applications

    places = applications.light_arc(count, intensity=LAMP_INTENSITY)
    pictures = list(
        applications.sweep(face, places, others=others, ambient=ambient, camera=camera, shape=(size, size))
    )
    frames = applications.frames_srgb(pictures, exposure)
    if out.suffix.lower() == ANIMATED:
        applications.write_gif(out, frames)
    else:
        applications.write_frames(out, frames)


def _write_relit(
    relit: RelitFace, camera: Any, size: int, texture: bool, exposure: float | None, out: Path
) -> None:
    import numpy as np

    from scan2albedo.applications import Picture
    from scan2albedo.io.images import write_exr, write_image

    if out.suffix.lower() == TEXTURED:
        relit.write_glb(out, exposure=exposure)
        return
    if texture:
        picture = Picture(relit.texture_linear, relit.face.mask.astype(np.float32))
    else:
        picture = relit.picture(camera, shape=(size, size))
    if out.suffix.lower() == ".exr":
        write_exr(out, np.dstack([picture.linear * (1.0 if exposure is None else exposure), picture.alpha]))
    else:
        write_image(out, picture.srgb(exposure))


def swap(
    a: Annotated[Path, typer.Argument(help="Folder of the processed scan that gives the shape.")],
    b: Annotated[Path, typer.Argument(help="Folder of the processed scan that gives the skin.")],
    out: OutFolder,
    keep_level: Annotated[
        bool, typer.Option("--keep-level", help="Leave B's albedo at its own level, not A's.")
    ] = False,
    json_summary: JsonOption = False,
) -> None:
    """Give A's shape B's skin."""
    from scan2albedo.applications import SwapOptions, load_result, swap_texture

    first, second = load_result(a), load_result(b)
    made = swap_texture(first, second, options=SwapOptions(match_level=not keep_level))
    _finish(made, out, "swap", [first, second], {"match_level": not keep_level}, json_summary)


def blend(
    a: Result,
    b: Result,
    out: OutFolder,
    weight: Annotated[float, typer.Option(help="0 is all A, 1 is all B.")] = 0.5,
    json_summary: JsonOption = False,
) -> None:
    """Make a face between two, in shape and skin."""
    from scan2albedo.applications import blend_faces, load_result

    first, second = load_result(a), load_result(b)
    made = blend_faces(first, second, weight)
    _finish(made, out, "blend", [first, second], {"weight": weight}, json_summary)


def transfer_expression(
    neutral_a: Annotated[Path, typer.Argument(help="Folder of A's processed scan at rest.")],
    expression_a: Annotated[Path, typer.Argument(help="Folder of A's processed scan with the expression.")],
    neutral_b: Annotated[Path, typer.Argument(help="Folder of B's processed scan at rest.")],
    out: OutFolder,
    method: Annotated[
        str, typer.Option(help="addition, or local-frames: turned and scaled with the surface.")
    ] = "addition",
    strength: Annotated[float, typer.Option(help="Factor of the expression.")] = 1.0,
    correspondence: Annotated[
        str,
        typer.Option(
            help="refined: A at rest is fitted to the face with the expression; as-fitted: it is not; auto: "
            "refined where the faces are on the model's mesh."
        ),
    ] = "auto",
    model: Annotated[
        str,
        typer.Option(help="With which the faces were processed: default, or a model's or template's file."),
    ] = "default",
    json_summary: JsonOption = False,
) -> None:
    """Give B's face the expression of A's."""
    from scan2albedo import applications
    from scan2albedo.applications.expression_transfer import level_to_refine
    from scan2albedo.pipeline import chosen_model

    chosen: dict[str, Any] = {"method": method, "strength": strength, "correspondence": correspondence}
    try:
        options = applications.TransferOptions(**chosen)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None
    load = applications.load_result
    faces = [load(neutral_a), load(expression_a), load(neutral_b)]
    template = chosen_model(model)
    made = applications.transfer_expression(faces[0], faces[1], faces[2], options=options, model=template)
    refined = level_to_refine(faces[0].mesh, options, template) is not None
    chosen["correspondence"] = "refined" if refined else "as-fitted"
    _finish(made, out, "transfer-expression", faces, chosen, json_summary)


def _finish(
    face: ProcessedFace,
    out: Path,
    application: str,
    inputs: list[ProcessedFace],
    options: dict[str, Any],
    json_summary: bool,
) -> None:
    """Write the face and tell where."""
    from scan2albedo.applications import write_face

    stop_cleanly_on_interrupt(out)
    write_face(face, out, application=application, inputs=inputs, options=options)
    typer.echo(f"{face.name}: {application}; files in {out}", err=True)
    if json_summary:
        names = [given.name for given in inputs]
        echo_json({"face": face.name, "status": "done", "out": str(out), "inputs": names, "options": options})


def _light(text: str) -> PointLight:
    from scan2albedo.lighting import PointLight

    numbers = _angles("--light", text, 2, 4)
    intensity = numbers[2] if len(numbers) > 2 else LAMP_INTENSITY
    distance = numbers[3] if len(numbers) > 3 else math.inf
    if intensity < 0 or distance <= 0:
        raise typer.BadParameter(f"--light {text}: intensity may not be negative, a distance is above 0")
    return PointLight(math.radians(numbers[0]), math.radians(numbers[1]), distance, intensity)


def _angles(option: str, text: str, fewest: int, most: int) -> list[float]:
    """Return the numbers, separated by commas, of an option."""
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if not fewest <= len(numbers) <= most or not all(map(math.isfinite, numbers)):
        shape = "AZ,EL" if most == 2 else "AZ,EL[,INTENSITY[,DISTANCE_MM]]"
        raise typer.BadParameter(f"{option} {text!r}: expected {shape}, finite numbers")
    return numbers
