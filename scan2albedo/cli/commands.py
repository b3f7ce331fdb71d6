"""The command line: thin wrappers around the library's calls."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from scan2albedo.cli.applications import add_commands
from scan2albedo.cli.common import (
    INTERRUPTED,
    SOME_FAILED,
    TERMINATED,
    USAGE_ERROR,
    JsonOption,
    PrintableUsage,
    Terminated,
    echo_json,
    interrupts_raise,
    refuse_shared_folders,
    say,
    stop_cleanly_on_interrupt,
    with_process_flags,
)
from scan2albedo.cli.glasses import app as glasses_app
from scan2albedo.cli.identify import identify
from scan2albedo.cli.reflectance import app as reflectance_app
from scan2albedo.cli.report import report
from scan2albedo.core.landmarks import AUTO
from scan2albedo.core.raw_scan import scan_name
from scan2albedo.errors import Scan2AlbedoError, one_line
from scan2albedo.pipeline.options import ProcessOptions

BARE_ERRORS = (ValueError, MemoryError, OverflowError, RecursionError)
"""What the library raises of options that it refuses, and of work that is too large for the machine."""

app = typer.Typer(
    cls=PrintableUsage,
    help="A raw 3D face scan goes in; the registered, annotated, evenly sampled and unlit face comes out.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

app.add_typer(glasses_app, name="glasses")
app.add_typer(reflectance_app, name="reflectance")
add_commands(app)
app.command()(identify)
app.command()(report)

OutOption = Annotated[Path, typer.Option("--out", "-o", help="Folder for the results, one subfolder a scan.")]


@app.callback()
def _common() -> None:
    """scan2albedo."""


@app.command()
@with_process_flags()
def process(
    scans: Annotated[list[Path], typer.Argument(help="OBJ, PLY, GLB, STL or OFF files.", metavar="SCAN...")],
    out: OutOption,
    options: ProcessOptions,
    json_summary: JsonOption = False,
) -> None:
    """Process raw scans: register, fit, sample, find the light, remove it."""
    refuse_shared_folders(scans)
    one = options.landmarks not in (None, AUTO) and not Path(options.landmarks).is_dir()
    if len(scans) > 1 and one:
        raise typer.BadParameter(
            f"--landmarks is {options.landmarks}: for several scans give a folder with files named after them"
        )
    from scan2albedo.cli.progress import ProgressLines
    from scan2albedo.pipeline.process import process as run
    from scan2albedo.templates import chosen_model

    stop_cleanly_on_interrupt(out)
    template = chosen_model(options.model)
    for note in template.notes if template is not None else ():
        say(f"{options.model}: {note}")
    chosen = options.arguments() | {"model": template or "none"}
    summaries: list[dict[str, Any]] = []
    failures = 0
    for path in scans:
        name = scan_name(path)
        with ProgressLines(name) as progress:
            progress.say(f"{name}: reading {path}")
            try:
                result = run(path, out=out, on_progress=progress.update, **chosen)
            except (Scan2AlbedoError, *BARE_ERRORS) as error:
                failures += 1
                for warning in getattr(error, "__notes__", ()):
                    progress.say(f"{name}: {one_line(warning)}")
                progress.say(f"scan2albedo: error: {one_line(error)}")
                summaries.append({"scan": str(path), "status": "failed", "reason": one_line(error)})
                continue
            for note in result.notes:
                progress.say(f"{name}: {note}")
            progress.say(result.summary())
        done = {"scan": str(path), "status": "done", "out": str(result.out)}
        summaries.append({**done, "notes": list(result.notes), **result.metrics()})
    if json_summary:
        echo_json(summaries if len(scans) > 1 else summaries[0])
    if failures:
        raise typer.Exit(USAGE_ERROR if failures == len(scans) else SOME_FAILED)


@app.command()
@with_process_flags()
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
    options: ProcessOptions,
    jobs: Annotated[int, typer.Option(help="Processes; 0 for one a core, memory allowing.", min=0)] = 0,
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a dask scheduler, such as tcp://10.0.0.5:8786.")
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Keep what is done and unchanged, do the rest.")
    ] = False,
    timeout: Annotated[
        float | None, typer.Option(help="Seconds after which a scan is given up with its worker.")
    ] = None,
    json_summary: JsonOption = False,
) -> None:
    """Process many scans, several at a time; a scan that fails, or kills its worker, stops no other."""
    if timeout is not None and not timeout > 0:
        raise typer.BadParameter(f"--timeout is {timeout:g}, expected seconds above 0")
    from scan2albedo.batch import run_batch
    from scan2albedo.cli.progress import BatchLines
    from scan2albedo.io.atomic import removed_if_empty

    try:
        # The stages run in workers, so that signals may unwind here.
        with interrupts_raise(), removed_if_empty(out), BatchLines() as lines:
            report = run_batch(
                manifest,
                out,
                options=options,
                jobs=jobs or None,
                scheduler=scheduler,
                resume=resume,
                timeout_s=timeout,
                on_progress=lines.update,
            )
    except KeyboardInterrupt as stopped:
        terminated = isinstance(stopped, Terminated)
        what = "terminated" if terminated else "interrupted"
        say(f"scan2albedo: {what}; nothing half-written was left behind, and --resume goes on")
        raise typer.Exit(TERMINATED if terminated else INTERRUPTED) from None
    for line in report.summary().splitlines():
        say(line)
    if json_summary:
        echo_json(report.figures())
    if report.progress.failed:
        raise typer.Exit(SOME_FAILED if report.progress.done else USAGE_ERROR)


@app.command()
@with_process_flags("size", "quality", "seed")
def demo(
    options: ProcessOptions,
    out: OutOption = Path("demo_out"),
    json_summary: JsonOption = False,
) -> None:
    """Process the built-in raw scan and print the error against its ground truth."""
    stop_cleanly_on_interrupt(out)
    from scan2albedo.cli.progress import ProgressLines
    from scan2albedo.pipeline.demo import run_demo

    with ProgressLines("demo") as progress:
        report = run_demo(
            out,
            seed=options.seed,
            size=options.size,
            quality=options.quality,
            on_progress=progress.update,
        )
        progress.say(report.result.summary())
    if json_summary:
        echo_json(report.figures())
    else:
        typer.echo(report.table())


@app.command()
def validate(
    what: Annotated[str, typer.Argument(help="hemisphere, face, lighting or all.")] = "all",
    size: Annotated[int, typer.Option(help="Height and width of the geometry image in texels.", min=8)] = 256,
    seed: Annotated[int, typer.Option(help="Seed of the scenes.", min=0)] = 1,
    json_summary: JsonOption = False,
) -> None:
    """Reproduce the paper's tables on synthetic scenes, our figures beside theirs."""
    from scan2albedo.cli.progress import ProgressLines
    from scan2albedo.pipeline import validation

    tables: dict[str, Callable[..., Any]] = {
        "hemisphere": validation.validate_hemisphere,
        "face": validation.validate_face,
        "lighting": validation.validate_lighting,
    }
    chosen = list(tables) if what == "all" else [what]
    if unknown := [name for name in chosen if name not in tables]:
        raise typer.BadParameter(f"{unknown[0]!r} is none of {', '.join(tables)}, all")
    results = {}
    for name in chosen:
        with ProgressLines(name) as progress:
            results[name] = tables[name](
                size=size, seed=seed, on_row=lambda row, show=progress.say: show(row.text())
            )
    if json_summary:
        echo_json({name: table.figures() for name, table in results.items()})
        return
    for table in results.values():
        typer.echo(validation.format_table(table))


@app.command()
def doctor(json_summary: JsonOption = False) -> None:
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
        echo_json([asdict(finding) for finding in findings])
    if not all(finding.good for finding in findings):
        raise typer.Exit(SOME_FAILED)


def main() -> None:
    """Run the command line; every expected trouble ends in one line and an exit status."""
    stop_cleanly_on_interrupt(None)
    try:
        app()
    except Scan2AlbedoError as error:
        print(f"scan2albedo: error: {one_line(error)}", file=sys.stderr)
        sys.exit(USAGE_ERROR)
    except BARE_ERRORS as error:
        reason = f"{type(error).__name__}: {one_line(error)}"
        print(f"scan2albedo: error: {reason.removesuffix(': ')}", file=sys.stderr)
        sys.exit(USAGE_ERROR)


if __name__ == "__main__":
    main()
