"""The commands that reproduce experiments of the paper."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from scan2albedo.cli.common import JsonOption, echo_json, stop_cleanly_on_interrupt

app = typer.Typer(help="Experiments of the paper on synthetic populations.", no_args_is_help=True)

SCANS = "scans"
"""Folder of the results that keeps processed scans."""


@app.callback()
def _common() -> None:
    """Experiments."""


@app.command()
def recognition(
    out: Annotated[
        Path,
        typer.Option("--out", "-o", help="Folder for figures; scans are kept in it for the next run."),
    ] = Path("recognition_out"),
    persons: Annotated[int, typer.Option(help="How many people.", min=2)] = 60,
    probes: Annotated[int, typer.Option(help="Scans of each beside the gallery's.", min=1)] = 3,
    size: Annotated[int, typer.Option(help="Side of the geometry images, 128 or more.", min=8)] = 256,
    individuality: Annotated[
        float | None,
        typer.Option(help="Share of the skin's paint that is one's own, 0 to 1; less is harder."),
    ] = None,
    brdf: Annotated[
        list[str] | None, typer.Option(help="A reflectance to compare; may be repeated; all when omitted.")
    ] = None,
    budget: Annotated[float | None, typer.Option(help="Seconds; then report who is complete.")] = None,
    jobs: Annotated[int, typer.Option(help="Processes; 0 for one a core.", min=0)] = 0,
    seed: Annotated[int, typer.Option(help="Seed of the population.", min=0)] = 0,
    json_summary: JsonOption = False,
) -> None:
    """Scan and process a synthetic population, and identify persons by raw texture and by albedo (T fig. 10).

    A run that was stopped goes on where it was; one with more persons begins with those that are done.
    """
    from dataclasses import replace

    from scan2albedo.cli.progress import ProgressLines
    from scan2albedo.experiments.recognition import RecognitionExperimentOptions, run_recognition_experiment
    from scan2albedo.experiments.recognition.files import write_report
    from scan2albedo.io.result_folder import check_writable, removed_if_empty

    try:
        options = RecognitionExperimentOptions(persons=persons, probes=probes, size=size, seed=seed)
        if individuality is not None:
            crowd = replace(options.population, individuality=individuality)
            options = replace(options, population=crowd)
        if brdf:
            options = replace(options, brdfs=tuple(brdf))
        if budget is not None and not budget > 0:
            raise ValueError(f"budget is {budget}, expected seconds above 0")
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None
    stop_cleanly_on_interrupt(None)
    with removed_if_empty(out), ProgressLines("recognition") as progress:
        check_writable(out)
        report = run_recognition_experiment(
            out / SCANS,
            options=options,
            budget=budget,
            jobs=jobs or os.cpu_count() or 1,
            on_progress=progress.update,
        )
    write_report(report, out, out / SCANS)
    typer.echo(f"files in {out}", err=True)
    if json_summary:
        echo_json(report.figures())
    else:
        typer.echo(report.table())
