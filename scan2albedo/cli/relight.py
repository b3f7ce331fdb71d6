"""The command `relight`: a processed face under other light, as a picture, a GLB or a sweep."""

import math
from pathlib import Path
from typing import Annotated, Any

import typer

from scan2albedo.cli.common import JsonOption, echo_json, say, stop_cleanly_on_interrupt
from scan2albedo.core.lights import LAMP_RADIUS_DEG

LAMP_INTENSITY = 3.0
PICTURES, TEXTURED, ANIMATED = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".exr"), ".glb", ".gif"


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
    gloss: str = typer.Option(
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
    from scan2albedo.core import PointLight

    lights = []
    for text in light or ():
        az, el, *others = _angles("--light", text, 2, 4)
        intensity, distance = (*others, *(LAMP_INTENSITY, math.inf)[len(others) :])
        if intensity < 0 or distance <= 0:
            raise typer.BadParameter(f"--light {text}: intensity may not be negative, a distance is above 0")
        lights.append(
            PointLight(math.radians(az), math.radians(el), distance, intensity, radius_deg=lamp_radius)
        )
    camera_at = _angles("--view", view, 2, 2)
    extension = out.suffix.lower()
    if sweep is None and extension not in (*PICTURES, TEXTURED):
        wanted = ", ".join((*PICTURES, TEXTURED))
        raise typer.BadParameter(f"-o takes {wanted}, not {extension or 'a name without extension'}")
    if sweep is not None and extension not in (ANIMATED, ""):
        raise typer.BadParameter(f"--sweep writes a .gif or a folder of frames, not {extension}")
    if sweep is not None and texture:
        raise typer.BadParameter("--sweep writes pictures; leave out --texture")
    if sweep is not None and environment is not None:
        raise typer.BadParameter("--sweep moves a lamp; leave out --environment")
    if not lights and environment is None and sweep is None:
        raise typer.BadParameter("no light is given; add --light, --environment or --sweep")
    if exposure is not None and not (math.isfinite(exposure) and exposure > 0):
        raise typer.BadParameter(f"--exposure is {exposure}, expected a number above 0")
    import numpy as np

    from scan2albedo import applications
    from scan2albedo.applications.files import FACE_FILES
    from scan2albedo.applications.light_sweep import FRAMES
    from scan2albedo.io.images import read_image_linear, write_exr, write_image
    from scan2albedo.io.run_folder import RunFolder
    from scan2albedo.pipeline.result import FILES as SCAN_FILES

    ours = FACE_FILES.holds(out.name) or SCAN_FILES.holds(out.name)
    if out.resolve() == result.resolve() or (ours and out.resolve().parent == result.resolve()):
        raise typer.BadParameter(f"-o {out} is part of the processed scan itself; choose another name")
    try:
        options = applications.RelightOptions(gloss=gloss, fill_gaps=not keep_gaps)  # type: ignore[arg-type]
    except ValueError as error:
        raise typer.BadParameter(f"--gloss: {error}") from None
    stop_cleanly_on_interrupt(None)
    if sweep is not None and not extension:
        RunFolder(out, FRAMES).check()
    face = applications.load_result(result)
    azimuth, elevation = (math.radians(angle) for angle in camera_at)
    shape = (size, size)
    try:
        camera = applications.default_camera(face, shape, azimuth_rad=azimuth, elevation_rad=elevation)
    except ValueError as error:
        raise typer.BadParameter(f"--view {view}: {error}") from None
    map_linear = None if environment is None else read_image_linear(environment)
    relit = applications.relight(
        face, lights, environment_linear=map_linear, ambient=ambient, options=options
    )
    for note in relit.notes:
        say(f"{face.name}: {note}")
    if sweep is not None:
        places = applications.light_arc(sweep, intensity=LAMP_INTENSITY, radius_deg=lamp_radius)
        as_prepared = applications.RelightOptions(gloss="found", fill_gaps=False)
        asked: dict[str, Any] = {"others": lights, "ambient": ambient, "camera": camera, "shape": shape}
        pictures = list(applications.sweep(relit.face, places, **asked, options=as_prepared))
        write = applications.write_gif if extension == ANIMATED else applications.write_frames
        write(out, applications.frames_srgb(pictures, exposure))
    elif extension == TEXTURED:
        relit.write_glb(out, exposure=exposure)
    else:
        if texture:
            picture = applications.Picture(relit.texture_linear, relit.face.mask.astype(np.float32))
        else:
            picture = relit.picture(camera, shape=shape)
        if extension == ".exr":
            write_exr(out, np.dstack([picture.linear * (exposure or 1.0), picture.alpha]))
        else:
            write_image(out, picture.srgb(exposure))
    say(f"{face.name}: relit; {out}")
    if json_summary:
        summary = {"face": face.name, "status": "done", "out": str(out), "lights": len(lights)}
        echo_json({**summary, "notes": list(relit.notes)})


def _angles(option: str, text: str, fewest: int, most: int) -> list[float]:
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    usual = all(abs(number) <= bound for number, bound in zip(numbers, (360, 360, 1e9, 1e9), strict=False))
    if not (fewest <= len(numbers) <= most and usual):
        shape = "AZ,EL" if most == 2 else "AZ,EL[,INTENSITY[,DISTANCE_MM]]"
        wanted = "angles of at most 360 degrees, other numbers of at most 1e9"
        raise typer.BadParameter(f"{option} {text!r}: expected {shape}, {wanted}")
    return numbers
