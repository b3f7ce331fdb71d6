"""The command line: thin wrappers around the library's calls."""

from __future__ import annotations

import inspect
import signal
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from scan2albedo.cli import common
from scan2albedo.cli.applications import bake, blend, personal_model, swap, transfer_expression
from scan2albedo.cli.glasses import app as glasses_app
from scan2albedo.cli.identify import identify
from scan2albedo.cli.reflectance import app as reflectance_app
from scan2albedo.cli.relight import relight
from scan2albedo.core.arrays import Values
from scan2albedo.core.landmarks import AUTO
from scan2albedo.core.raw_scan import lost_texture, scan_name
from scan2albedo.core.version import VERSION
from scan2albedo.errors import Scan2AlbedoError, one_line

if TYPE_CHECKING:
    from scan2albedo.pipeline.options import ProcessOptions

BARE_ERRORS = (ValueError, MemoryError, OverflowError, RecursionError)
"""What the library raises of options that it refuses, and of work that is too large for the machine."""

app = typer.Typer(
    cls=common.PrintableUsage,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"scan2albedo {VERSION}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and end."),
    ] = False,
) -> None:
    """A raw 3D face scan goes in; the registered, annotated, evenly sampled and unlit face comes out."""


OutOption = Annotated[Path, typer.Option("--out", "-o", help="Folder for the results, one subfolder a scan.")]
Strict = Annotated[bool, typer.Option("--strict", help="Exit with 1 where a scan's texture is missing.")]


def _flags(
    model: str = typer.Option(
        "default", help="A model's JSON file; a template's mesh; 'default'; or 'none' for an object, no face."
    ),
    size: int | None = typer.Option(
        None,
        help="Height and width of the geometry image in texels; else 512, in drafts 256, in best 1024.",
        min=8,
    ),
    lights: str = typer.Option("auto", help="'auto', or how many."),
    brdf: str = typer.Option("oren-nayar", help="oren-nayar, lambert, minnaert or spherical-harmonics."),
    unit: str = typer.Option("auto", help="auto, mm, cm or m."),
    quality: str = typer.Option(
        "standard", help="draft, standard, best (standard with 1024 texels a side), or paper.", metavar="NAME"
    ),
    budget: float | None = typer.Option(None, help="Seconds a scan may take."),
    seed: int = typer.Option(0, help="Seed of every random step.", min=0),
    skip: list[str] | None = typer.Option(None, help="A stage to leave out; may be repeated."),
    force: list[str] | None = typer.Option(
        None, help="An optional step to carry out in any case, such as albedo.shadows; may be repeated."
    ),
    pictures: bool = typer.Option(True, help="Draw overview.png and error_vs_time.png among the files."),
    files: str = typer.Option(
        "standard", help="minimal: without pictures, EXR of the geometry image and light; standard; or all."
    ),
    textures: str | None = typer.Option(
        None, help="Folder from which textures may be read beside the scan's own.", metavar="DIR"
    ),
    landmarks: str | None = typer.Option(
        None,
        help="Landmarks placed by hand, any of 68: a CSV, JSON or MeshLab .pp file, or a folder with files "
        "named after the scans; or auto for those that MediaPipe finds (needs the extra named landmarks).",
        metavar="FILE|auto",
    ),
    unlit: str | None = typer.Option(
        None,
        help="Also write the scan itself without its light: 'face', or 'all' of it with the same lamps.",
        metavar="face|all",
    ),
    maps: str | None = typer.Option(
        None,
        help="Also normal, displacement, cavity, occlusion, roughness, specular maps, GLB and OpenUSD: "
        "on the chart, the scan's own texture coordinates, or your template's.",
        metavar="chart|scan|template",
    ),
    texture_size: int = typer.Option(
        1024, help="Height and width of those, and of the texture on your own template, up to 8192.", min=8
    ),
    white_balance: str = typer.Option(
        "none",
        help="none; grey-skin: skin gets people's mean colour; or the linear colour of something grey in it.",
        metavar="none|grey-skin|R,G,B",
    ),
    linear_model: str | None = typer.Option(
        None,
        help="A linear (morphable) model's file (FLAME, Basel, Surrey, your own) to fit coefficients of.",
        metavar="FILE",
    ),
) -> None:
    """Hold the flags of `process`, `person`, `batch` and `demo`, named as the fields of `ProcessOptions`."""


def _with_flags(*names: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command, which takes them as `**flags`, those of `_flags` before its own optional ones."""

    def decorated(command: Callable[..., None]) -> Callable[..., None]:
        shared = inspect.signature(_flags, eval_str=True).parameters
        *own, _ = inspect.signature(command, eval_str=True).parameters.values()
        place = [option.default is not option.empty for option in own].index(True)
        own[place:place] = [shared[name] for name in names or shared]
        command.__signature__ = inspect.Signature(own)  # type: ignore[attr-defined]
        return command

    return decorated


def _process_options(context: typer.Context, scans: Sequence[Path] = ()) -> ProcessOptions:
    from dataclasses import fields

    from scan2albedo.pipeline.options import ProcessOptions

    names = {option.name for option in fields(ProcessOptions)}
    given = {name: value for name, value in context.params.items() if name in names}
    given |= {name: tuple(given.get(name) or ()) for name in ("skip", "force")}
    common.refuse_shared_folders(scans)
    try:
        options = ProcessOptions(**given)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None
    if len(scans) > 1 and options.landmarks not in (None, AUTO) and not Path(options.landmarks).is_dir():
        raise typer.BadParameter(
            f"--landmarks is {options.landmarks}: for several scans give a folder with files named after them"
        )
    return options


@app.command()
@_with_flags()
def process(
    context: typer.Context,
    scans: Annotated[list[Path], typer.Argument(help="OBJ, PLY, GLB, STL or OFF files.", metavar="SCAN...")],
    out: OutOption,
    strict: Strict = False,
    json_summary: common.JsonOption = False,
    **flags: Any,
) -> None:
    """Process raw scans: register, fit, sample, find the light, remove it."""
    options = _process_options(context, scans)
    from scan2albedo.pipeline.process import process as run
    from scan2albedo.templates import chosen_model

    template = chosen_model(options.model)
    for note in template.notes if template is not None else ():
        common.say(f"{options.model}: {note}")
    chosen = options.arguments() | {"model": template or "none"}
    summaries: list[Values] = []
    failures = 0
    lost = False
    for path in scans:
        name = scan_name(path)
        with common.working(name, out) as progress:
            progress.say(f"{name}: reading {path}")
            try:
                result = run(path, out=out, on_progress=progress.update, **chosen)
            except (Scan2AlbedoError, *BARE_ERRORS) as error:
                failures += 1
                for doubt in getattr(error, "__notes__", ()):
                    progress.say(f"{name}: {one_line(doubt)}")
                progress.say(f"scan2albedo: error: {one_line(error)}")
                summaries.append({"scan": str(path), "status": "failed", "reason": one_line(error)})
                continue
            for note in result.notes:
                progress.say(f"{name}: {note}")
            progress.say(result.summary())
        lost |= lost_texture(result.notes) is not None
        done = {"scan": str(path), "status": "done", "out": str(result.out)}
        summaries.append({**done, "notes": list(result.notes), **result.metrics()})
    if json_summary:
        common.echo_json(summaries if len(scans) > 1 else summaries[0])
    if failures:
        raise typer.Exit(common.USAGE_ERROR if failures == len(scans) else common.SOME_FAILED)
    if strict and lost:
        common.say("scan2albedo: --strict: a texture is missing, so the exit status is 1")
        raise typer.Exit(common.SOME_FAILED)


@app.command()
@_with_flags()
def person(
    context: typer.Context,
    name: Annotated[str, typer.Argument(help="Of the person: the results get a folder of this name.")],
    scans: Annotated[list[Path], typer.Argument(help="Scans of the person.", metavar="SCAN...")],
    out: OutOption,
    sequence: bool = typer.Option(False, "--sequence", help="The scans are a take's frames, in order."),
    fps: float = typer.Option(30.0, help="Frames a second of --sequence."),
    json_summary: common.JsonOption = False,
    **flags: Any,
) -> None:
    """Process several scans of one person into one shape and one albedo, or a take into a mesh that moves."""
    options = _process_options(context, () if sequence else scans).arguments()
    from scan2albedo.pipeline.person import process_person
    from scan2albedo.pipeline.sequence import process_sequence

    with common.working(name, out) as progress:
        progress.say(f"{name}: {len(scans)} {'frames' if sequence else 'scans'}")
        run = partial(process_sequence, fps=fps) if sequence else process_person
        result = run(scans, out, name=name, on_progress=progress.update, **options)
        for note in result.notes:
            progress.say(f"{name}: {note}")
        progress.say(result.summary())
    if json_summary:
        common.echo_json(
            {"name": name, "out": str(result.out), "notes": list(result.notes), **result.metrics()}
        )
    if result.left_out:
        raise typer.Exit(common.SOME_FAILED)


@app.command()
@_with_flags()
def batch(
    context: typer.Context,
    manifest: Annotated[
        Path,
        typer.Argument(
            help="A CSV file with a column `scan` (and `name`, `unit`, `model`, `lights`, `seed`, "
            "`landmarks`, or any others); a list of paths; or a folder of scans."
        ),
    ],
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder for the results, catalogue.parquet and batch.json.")
    ],
    jobs: int = typer.Option(0, help="Processes; 0 for one a core, memory allowing.", min=0),
    scheduler: str | None = typer.Option(
        None, help="Address of a dask scheduler, such as tcp://10.0.0.5:8786."
    ),
    resume: bool = typer.Option(False, "--resume", help="Keep what is done and unchanged, do the rest."),
    timeout: float | None = typer.Option(
        None, help="Seconds after which a scan is given up with its worker."
    ),
    strict: Strict = False,
    json_summary: common.JsonOption = False,
    **flags: Any,
) -> None:
    """Process many scans, several at a time; a scan that fails, or kills its worker, stops no other."""
    if timeout is not None and not timeout > 0:
        raise typer.BadParameter(f"--timeout is {timeout:g}, expected seconds above 0")
    options = _process_options(context)
    from scan2albedo.batch import run_batch
    from scan2albedo.cli.progress import BatchLines
    from scan2albedo.io.atomic import removed_if_empty

    common.interrupts_raise()  # the stages run in workers, so that signals may unwind here
    try:
        with removed_if_empty(out), BatchLines("batch") as lines:
            done = run_batch(
                manifest,
                out,
                options=options,
                jobs=jobs or None,
                scheduler=scheduler,
                resume=resume,
                timeout_s=timeout,
                on_progress=lines.show,
            )
    except KeyboardInterrupt as stopped:
        number = stopped.args[0] if stopped.args else signal.SIGINT
        what = "terminated" if number == signal.SIGTERM else "interrupted"
        common.say(f"scan2albedo: {what}; nothing half-written was left behind, and --resume goes on")
        raise typer.Exit(128 + number) from None
    finally:
        common.stop_cleanly_on_interrupt(None)
    for line in done.summary().splitlines():
        common.say(line)
    if json_summary:
        common.echo_json(done.figures())
    if done.progress.failed:
        raise typer.Exit(common.SOME_FAILED if done.progress.done else common.USAGE_ERROR)
    if strict and lost_texture(done.notes):
        raise typer.Exit(common.SOME_FAILED)


@app.command()
@_with_flags("size", "quality", "seed")
def demo(
    context: typer.Context,
    out: OutOption = Path("demo_out"),
    json_summary: common.JsonOption = False,
    **flags: Any,
) -> None:
    """Process the built-in raw scan and print the error against its ground truth."""
    _process_options(context)
    from scan2albedo.pipeline.demo import run_demo

    with common.working("demo", out) as progress:
        done = run_demo(out, **flags, on_progress=progress.update)
        progress.say(done.result.summary())
    if json_summary:
        common.echo_json(done.figures())
    else:
        typer.echo(done.table())


@app.command()
def validate(
    what: str = typer.Argument("all", help="hemisphere, face, lighting or all."),
    size: int = typer.Option(256, help="Height and width of the geometry image in texels.", min=8),
    seed: int = typer.Option(1, help="Seed of the scenes.", min=0),
    json_summary: common.JsonOption = False,
) -> None:
    """Reproduce the paper's tables on synthetic scenes, our figures beside theirs."""
    from scan2albedo.cli.progress import ProgressLines
    from scan2albedo.pipeline import validation

    names = ("hemisphere", "face", "lighting")
    if what not in (*names, "all"):
        raise typer.BadParameter(f"{what!r} is unknown, expected one of {', '.join(names)}, all")
    results: Values = {}
    for name in names if what == "all" else (what,):
        with ProgressLines(name) as progress:
            asked: Values = {"size": size, "seed": seed}
            asked["on_row"] = lambda row, say=progress.say: common.say(row.text())
            if name == "lighting":
                results[name] = validation.validate_lighting(**asked)
            else:
                results[name] = validation.validate_scenes(name, **asked)
    if json_summary:
        common.echo_json({name: table.figures() for name, table in results.items()})
    else:
        typer.echo("\n".join(table.text() for table in results.values()))


@app.command()
def doctor(json_summary: common.JsonOption = False) -> None:
    """Show what is missing on this machine and the command that mends it."""
    from dataclasses import asdict

    from scan2albedo.cli.doctor import examine

    findings = []
    for finding in examine():
        findings.append(finding)
        if not json_summary:
            typer.echo(f"{'ok     ' if finding.good else 'MISSING'}  {finding.subject}: {finding.detail}")
            if finding.remedy:
                typer.echo(f"         mend it with: {finding.remedy}")
    if json_summary:
        common.echo_json([asdict(finding) for finding in findings])
    if not all(finding.good for finding in findings):
        raise typer.Exit(common.SOME_FAILED)


@app.command()
def report(
    out: Annotated[
        Path,
        typer.Argument(help="What process or batch wrote: OUT, or the folder of one scan.", metavar="OUT"),
    ],
    path: Path | None = typer.Option(None, "--out", "-o", help="The page; OUT/report.html when omitted."),
    scans: int = typer.Option(
        40, help="How many scans of a batch are shown in full, the worst first.", min=0
    ),
    json_summary: common.JsonOption = False,
) -> None:
    """Show what happened to a scan or a batch as one HTML page that needs no network."""
    if path is not None and path.suffix.lower() not in (".html", ".htm"):
        raise typer.BadParameter(f"-o takes a name that ends in .html, not {path}")
    from dataclasses import asdict

    from scan2albedo.report import write_report
    from scan2albedo.report.html.texts import size_text

    common.stop_cleanly_on_interrupt(None)
    written = write_report(out, path, scans=scans, on_progress=common.say)
    common.say(f"{written.path}: {written.scans} scans, {size_text(written.size_bytes)}")
    if json_summary:
        figures = asdict(written)
        common.echo_json({"status": "done", "out": str(figures.pop("path")), **figures})


# Behind the ones above in what `--help` lists.
for command in (relight, swap, blend, transfer_expression, personal_model, bake, identify):
    app.command()(command)
app.add_typer(glasses_app, name="glasses")
app.add_typer(reflectance_app, name="reflectance")


def main() -> None:
    """Run the command line; every expected trouble ends in one line and an exit status."""
    common.stop_cleanly_on_interrupt(None)
    try:
        app()
    except (Scan2AlbedoError, *BARE_ERRORS) as error:
        print(f"scan2albedo: error: {one_line(error)}", file=sys.stderr)
        sys.exit(common.USAGE_ERROR)


if __name__ == "__main__":
    main()
