"""`scan2albedo batch`: many scans, one table."""

from __future__ import annotations

import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from scan2albedo.cli.common import INTERRUPTED, SOME_FAILED, USAGE_ERROR, JsonOption, echo_json
from scan2albedo.cli.process_flags import with_process_flags

if TYPE_CHECKING:
    from scan2albedo.pipeline.options import ProcessOptions


@with_process_flags
def batch(
    manifest: Annotated[
        Path,
        typer.Argument(
            help="A CSV file with a column `scan` (and `name`, `unit`, `model`, `lights`, `seed`, or any "
            "others); a list of paths; or a folder of scans."
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
    # The stages run in workers, so that Ctrl-C may unwind here.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    from scan2albedo.batch import run_batch
    from scan2albedo.cli.batch_progress import BatchLines
    from scan2albedo.io.result_folder import removed_if_empty

    try:
        with removed_if_empty(out), BatchLines() as lines:
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
    except KeyboardInterrupt:
        print(
            "scan2albedo: interrupted; nothing half-written was left behind, and --resume goes on",
            file=sys.stderr,
        )
        raise typer.Exit(INTERRUPTED) from None
    typer.echo(report.summary(), err=True)
    if json_summary:
        echo_json(report.figures())
    if report.progress.failed:
        raise typer.Exit(SOME_FAILED if report.progress.done else USAGE_ERROR)
