"""The command that sweeps every stage's knobs on scenes with truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from scan2albedo.cli.common import JsonOption, echo_json, stop_cleanly_on_interrupt


def benchmark(
    stages: Annotated[
        list[str] | None,
        typer.Argument(
            help="register, fit, geometry_image, albedo, weights, glasses; all when omitted.",
            metavar="[STAGE...]",
        ),
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for tables, curves and figure.")] = Path(
        "benchmark_out"
    ),
    quick: Annotated[bool, typer.Option("--quick", help="Tiny scenes: to see that it runs.")] = False,
    repeats: Annotated[int, typer.Option(help="Runs of each setting; the cheapest counts.", min=1)] = 1,
    budgets: Annotated[bool, typer.Option(help="Check budgets in seconds too.")] = True,
    json_summary: JsonOption = False,
) -> None:
    """Sweep the quality knobs of the stages: error against CPU time, beside other methods.

    Prints, for each stage, a table of settings with the Pareto front, its knee and the default, and whether
    budgets in seconds are kept; writes the same with a figure. What other methods lack is said.
    """
    from scan2albedo.benchmarks.run import STAGES, run_benchmarks, write_benchmarks
    from scan2albedo.cli.progress import ProgressLines
    from scan2albedo.io.result_folder import check_writable, removed_if_empty

    chosen = tuple(dict.fromkeys(stages or STAGES))
    if unknown := [name for name in chosen if name not in STAGES]:
        raise typer.BadParameter(f"{unknown[0]!r} is none of {', '.join(STAGES)}")
    stop_cleanly_on_interrupt(None)
    with removed_if_empty(out), ProgressLines("benchmark") as progress:
        check_writable(out)
        report = run_benchmarks(
            stages or (),
            quick=quick,
            repeats=repeats,
            budgets=budgets,
            on_point=lambda stage, point: progress.say(f"{stage}: {point.line()}"),
            on_budget=lambda row: progress.say(row.text()),
        )
        files = write_benchmarks(report, out)
    typer.echo(f"files in {out}: {', '.join(path.name for path in files)}", err=True)
    if json_summary:
        echo_json(report.figures())
    else:
        typer.echo(report.text())
