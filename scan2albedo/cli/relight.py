"""The command `relight`: a processed face under other light, as a picture, a GLB or a sweep."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from scan2albedo.cli.common import JsonOption, echo_json, say, stop_cleanly_on_interrupt
from scan2albedo.core.lights import LAMP_RADIUS_DEG

if TYPE_CHECKING:
    from scan2albedo.applications import Picture
    from scan2albedo.core import PointLight

LAMP_INTENSITY = 3.0
TEXTURED = ".glb"
ANIMATED = ".gif"
WRITTEN = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".exr", TEXTURED)


def relight(
    result: Annotated[Path, typer.Argument(help="Folder of a processed scan, OUT/<scan name>.")],
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            "-o",
            help="A picture (.png .jpg .tif .exr), the face (.glb), or with --sweep a .gif or a folder of "
            "frames.",
        ),
    ],
    light: list[str] | None = typer.Option(
        None,
        help="AZ,EL[,INTENSITY[,DISTANCE_MM]] in degrees from the front toward the subject's left "
        "and up; intensity 3 when omitted, ambient light being 1; distant when omitted; may be repeated.",
    ),
    environment: Path | None = typer.Option(
        None, help="Latitude-longitude picture that lights the face: .exr, .hdr or any other."
    ),
    lamp_radius: float = typer.Option(
        LAMP_RADIUS_DEG,
        help="Size of each lamp: angular radius in degrees as seen from the face, which makes edges "
        "of shadows soft; 0 is a point.",
        min=0,
        max=89,
    ),
    gloss: Literal["auto", "found", "none"] = typer.Option(
        "auto",
        help="auto: the highlight that the estimate found, or skin's usual one where it found none; "
        "found; none.",
    ),
    keep_gaps: bool = typer.Option(
        False, "--keep-gaps", help="Leave hair before the ears, and texels without albedo, as they are."
    ),
    ambient: float | None = typer.Option(
        None, help="Light without direction; 1, or 0 with an environment.", min=0
    ),
    view: str = typer.Option("0,0", help="AZ,EL of the camera in degrees."),
    size: int = typer.Option(512, help="Height and width of the picture.", min=8, max=8192),
    texture: bool = typer.Option(
        False, "--texture", help="Write the relit texture on its chart, not a picture."
    ),
    sweep: int | None = typer.Option(
        None,
        help="Number of places of a light that goes around the face (a GIF goes there and back). "
        "A film of frames in a folder: "
        "ffmpeg -framerate 12 -i frame_%03d.png -pix_fmt yuv420p sweep.mp4",
        min=1,
        max=1000,
    ),
    exposure: float | None = typer.Option(
        None, help="Factor of what 8-bit pictures show; by itself when omitted."
    ),
    json_summary: JsonOption = False,
) -> None:
    """Show a processed face under other light, with its shadows."""
    lamps = [_lamp(text, lamp_radius) for text in light or ()]
    azimuth, elevation = (math.radians(angle) for angle in _angles("--view", view, 2, 2))
    extension = out.suffix.lower()
    has_light = bool(lamps) or environment is not None or sweep is not None
    if extension not in (WRITTEN if sweep is None else (ANIMATED, "")):
        takes = f"{', '.join(WRITTEN)}, or with --sweep {ANIMATED} or a folder of frames"
        raise typer.BadParameter(f"-o takes {takes}, not {out.name}")
    if sweep is not None and (texture or environment is not None):
        raise typer.BadParameter("--sweep moves a lamp in pictures; leave out --texture and --environment")
    if not has_light:
        raise typer.BadParameter("no light is given; add --light, --environment or --sweep")
    if exposure is not None and not 0 < exposure < math.inf:
        raise typer.BadParameter(f"--exposure is {exposure}, expected a number above 0")
    from scan2albedo import applications
    from scan2albedo.applications.light_sweep import FRAMES
    from scan2albedo.io.images import read_image_linear
    from scan2albedo.io.run_folder import RunFolder

    if out.resolve() == result.resolve() or (out.resolve().parent == result.resolve() and _is_ours(out.name)):
        raise typer.BadParameter(f"-o {out} is part of the processed scan itself; choose another name")
    options = applications.RelightOptions(gloss=gloss, fill_gaps=not keep_gaps)
    stop_cleanly_on_interrupt(None)
    if sweep is not None and not extension:
        RunFolder(out, FRAMES).check()
    face = applications.load_result(result)
    shape = (size, size)
    try:
        camera = applications.default_camera(face, shape, azimuth_rad=azimuth, elevation_rad=elevation)
    except ValueError as error:
        raise typer.BadParameter(f"--view {view}: {error}") from None
    map_linear = None if environment is None else read_image_linear(environment)
    relit = applications.relight(face, lamps, environment_linear=map_linear, ambient=ambient, options=options)
    for note in relit.notes:
        say(f"{face.name}: {note}")
    if sweep is not None:
        places = applications.light_arc(sweep, intensity=LAMP_INTENSITY, radius_deg=lamp_radius)
        as_prepared = applications.RelightOptions(gloss="found", fill_gaps=False)
        pictures = applications.sweep(
            relit.face,
            places,
            others=lamps,
            ambient=ambient,
            camera=camera,
            shape=shape,
            options=as_prepared,
        )
        write = applications.write_gif if extension == ANIMATED else applications.write_frames
        write(out, applications.frames_srgb(list(pictures), exposure))
    elif extension == TEXTURED:
        relit.write_glb(out, exposure=exposure)
    elif texture:
        mask = relit.face.mask.astype("float32")
        _write_picture(out, applications.Picture(relit.texture_linear, mask), exposure)
    else:
        _write_picture(out, relit.picture(camera, shape=shape), exposure)
    say(f"{face.name}: relit; {out}")
    if json_summary:
        summary = {"face": face.name, "status": "done", "out": str(out), "lights": len(lamps)}
        echo_json({**summary, "notes": list(relit.notes)})


def _is_ours(name: str) -> bool:
    """Return whether a processed scan, or a face that an application made, has a file of this name."""
    from scan2albedo.applications.files import FACE_FILES
    from scan2albedo.pipeline.process import FILES

    return FACE_FILES.holds(name) or FILES.holds(name)


def _write_picture(out: Path, picture: "Picture", exposure: float | None) -> None:
    """Write a picture: linear as EXR, else as it is shown."""
    import numpy as np

    from scan2albedo.io.images import write_exr, write_image

    if out.suffix.lower() == ".exr":
        write_exr(out, np.dstack([picture.linear * (exposure or 1.0), picture.alpha]))
    else:
        write_image(out, picture.srgb(exposure))


def _lamp(text: str, radius_deg: float) -> "PointLight":
    """Return the lamp of one --light."""
    from scan2albedo.core import PointLight

    azimuth, elevation, *others = _angles("--light", text, 2, 4)
    intensity, distance = (*others, *(LAMP_INTENSITY, math.inf)[len(others) :])
    if intensity < 0 or distance <= 0:
        raise typer.BadParameter(f"--light {text}: intensity may not be negative, a distance is above 0")
    return PointLight(
        math.radians(azimuth), math.radians(elevation), distance, intensity, radius_deg=radius_deg
    )


def _angles(option: str, text: str, fewest: int, most: int) -> list[float]:
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    in_range = all(abs(number) <= bound for number, bound in zip(numbers, (360, 360, 1e9, 1e9), strict=False))
    if not (fewest <= len(numbers) <= most and in_range):
        shape = "AZ,EL" if most == 2 else "AZ,EL[,INTENSITY[,DISTANCE_MM]]"
        wanted = "angles of at most 360 degrees, other numbers of at most 1e9"
        raise typer.BadParameter(f"{option} {text!r}: expected {shape}, {wanted}")
    return numbers
