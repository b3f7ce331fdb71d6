"""From read files to written ones: lenses rendered, with lines that tell how far it is."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses import LensMaterial, LensPictureOptions
from scan2albedo.eyeglasses.app.lens_files import write_lens_files
from scan2albedo.eyeglasses.app.lens_input import LensInput
from scan2albedo.eyeglasses.app.lenses import LensView, render_lenses
from scan2albedo.eyeglasses.app.records import LensesRecord


def run_lenses(
    source: LensInput,
    lenses: tuple[LensMaterial | None, LensMaterial | None],
    options: LensPictureOptions,
    out: Path,
    say: Callable[[str], None],
) -> LensesRecord:
    """Render what was read, write the files into `out` and return their record.

    Raises
    ------
    EyeglassesError
        When lenses cannot be put in; names the key points' file or the frame's.
    OutputError
        When the files cannot be written.
    """
    name = source.frame.name
    for what, notes in (("frame", source.frame.scan.notes), ("head", source.head.notes)):
        for note in notes:
            say(f"{what}: {note}")

    def tell(view: LensView) -> None:
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
            on_view=tell,
        )
    except EyeglassesError as error:
        files = f"{source.frame.mesh_file} with {source.frame.keypoints_file}"
        raise EyeglassesError(f"{files}: {error}") from error
    for note in rendered.notes:
        say(f"{name}: {note}")
    record = write_lens_files(rendered, source, out)
    say(f"{name}: files in {out}")
    return record
