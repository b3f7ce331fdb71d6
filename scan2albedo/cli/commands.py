"""The command line: thin wrappers around the library's calls."""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import typer

from scan2albedo.cli import common
from scan2albedo.cli.applications import bake, blend, personal_model, swap, transfer_expression
from scan2albedo.cli.flags import DemoCommand, OptionsCommand
from scan2albedo.cli.glasses import app as glasses_app
from scan2albedo.cli.identify import identify
from scan2albedo.cli.reflectance import app as reflectance_app
from scan2albedo.cli.relight import relight
from scan2albedo.core.arrays import Values
from scan2albedo.core.landmarks import AUTO
from scan2albedo.core.raw_scan import lost_texture, scan_name
from scan2albedo.core.version import VERSION
from scan2albedo.errors import Scan2AlbedoError, one_line
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


Options = Annotated[ProcessOptions, typer.Option(parser=ProcessOptions)]
"""The flags of `process`, for an `OptionsCommand`."""


def _check_scans(scans: Sequence[Path], options: ProcessOptions) -> None:
    """Refuse scans that would share a folder, or one file of landmarks."""
    common.refuse_shared_folders(scans)
    if len(scans) > 1 and options.landmarks not in (None, AUTO) and not Path(options.landmarks).is_dir():
        raise typer.BadParameter(
            f"--landmarks is {options.landmarks}: for several scans give a folder with files named after them"
        )


@app.command(cls=OptionsCommand)
def process(
    scans: Annotated[list[Path], typer.Argument(help="OBJ, PLY, GLB, STL or OFF files.", metavar="SCAN...")],
    out: OutOption,
    options: Options,
    strict: Strict = False,
    json_summary: common.JsonOption = False,
) -> None:
    """Process raw scans: register, fit, sample, find the light, remove it."""
    _check_scans(scans, options)
    from scan2albedo.pipeline.process import process as run
    from scan2albedo.templates import chosen_model

    template = chosen_model(options.model)
    for note in template.notes if template is not None else ():
        common.say(f"{options.model}: {note}")
    options = replace(options, model=template or "none")
    summaries: list[Values] = []
    failures = 0
    lost = False
    for path in scans:
        name = scan_name(path)
        with common.working(name, out) as progress:
            progress.say(f"{name}: reading {path}")
            try:
                result = run(path, out, options, on_progress=progress.update)
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


@app.command(cls=OptionsCommand)
def person(
    name: Annotated[str, typer.Argument(help="Of the person: the results get a folder of this name.")],
    scans: Annotated[list[Path], typer.Argument(help="Scans of the person.", metavar="SCAN...")],
    out: OutOption,
    options: Options,
    sequence: bool = typer.Option(False, "--sequence", help="The scans are a take's frames, in order."),
    fps: float = typer.Option(30.0, help="Frames a second of --sequence."),
    json_summary: common.JsonOption = False,
) -> None:
    """Process several scans of one person into one shape and one albedo, or a take into a mesh that moves."""
    _check_scans([] if sequence else scans, options)
    from scan2albedo.pipeline.person import process_person
    from scan2albedo.pipeline.sequence import process_sequence

    with common.working(name, out) as progress:
        progress.say(f"{name}: {len(scans)} {'frames' if sequence else 'scans'}")
        run = partial(process_sequence, fps=fps) if sequence else process_person
        result = run(scans, out, name=name, on_progress=progress.update, **options.arguments())
        for note in result.notes:
            progress.say(f"{name}: {note}")
        progress.say(result.summary())
    if json_summary:
        common.echo_json(
            {"name": name, "out": str(result.out), "notes": list(result.notes), **result.metrics()}
        )
    if result.left_out:
        raise typer.Exit(common.SOME_FAILED)


@app.command(cls=OptionsCommand)
def batch(
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
    options: Options,
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
) -> None:
    """Process many scans, several at a time; a scan that fails, or kills its worker, stops no other."""
    if timeout is not None and not timeout > 0:
        raise typer.BadParameter(f"--timeout is {timeout:g}, expected seconds above 0")
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


@app.command(cls=DemoCommand)
def demo(
    options: Options,
    out: OutOption = Path("demo_out"),
    json_summary: common.JsonOption = False,
) -> None:
    """Process the built-in raw scan and print the error against its ground truth."""
    from scan2albedo.pipeline.demo import run_demo

    with common.working("demo", out) as progress:
        done = run_demo(
            out,
            size=options.size,
            quality=options.quality,
            seed=options.seed,
            on_progress=progress.update,
        )
        progress.say(done.result.summary())
    if json_summary:
        common.echo_json(done.figures())
    else:
        typer.echo(done.table())


@app.command()
def validate(
    what: Literal["hemisphere", "face", "lighting", "all"] = typer.Argument(
        "all", help="hemisphere, face, lighting or all."
    ),
    size: int = typer.Option(256, help="Height and width of the geometry image in texels.", min=8),
    seed: int = typer.Option(1, help="Seed of the scenes.", min=0),
    json_summary: common.JsonOption = False,
) -> None:
    """Reproduce the paper's tables on synthetic scenes, our figures beside theirs."""
    from scan2albedo.cli.progress import ProgressLines
    from scan2albedo.pipeline import validation

    results: Values = {}
    for name in ("hemisphere", "face", "lighting") if what == "all" else (what,):
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
def doctor(
    warm: bool = typer.Option(False, "--warm", help="Also compile the numerical kernels, once and for all."),
    json_summary: common.JsonOption = False,
) -> None:
    """Show what is missing on this machine and the command that mends it."""
    from dataclasses import asdict

    from scan2albedo.cli.doctor import compile_kernels, examine

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
    if warm:
        compile_kernels()


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
