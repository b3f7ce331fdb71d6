"""Run the benchmarks of several stages, and write what they found."""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.budgeted_stages import budget_rows
from benchmarks.budgets import BudgetRow, budget_table
from benchmarks.report import StageReport, csv_text
from benchmarks.sweep import Peer, Point, StageBenchmark, measured
from scan2albedo.io.atomic import make_folder, write_text

STAGES = {
    "register": "registration",
    "fit": "fitting",
    "geometry_image": "sampling",
    "albedo": "albedo",
    "weights": "weights",
    "glasses": "glasses",
}
"""Stages that are swept, and their modules."""
FIGURE, TABLES, CURVES, NUMBERS = "error_vs_time.png", "benchmark.txt", "error_vs_time.csv", "benchmark.json"


@dataclass(frozen=True)
class BenchmarkReport:
    """All that one run measured."""

    stages: tuple[StageReport, ...]
    budgets: tuple[BudgetRow, ...]

    def text(self) -> str:
        """Return all tables."""
        tables = [stage.table() for stage in self.stages]
        return "\n\n".join([*tables, *([budget_table(self.budgets)] if self.budgets else [])])

    def figures(self) -> dict[str, Any]:
        """Return all as plain numbers for JSON."""
        return {
            "stages": [stage.figures() for stage in self.stages],
            "budgets": [row.figures() for row in self.budgets],
        }


def benchmark_of(stage: str) -> StageBenchmark:
    """Return the benchmark of a stage, loading what it needs only now.

    Raises
    ------
    ValueError
        For a name that is none of `STAGES`.
    """
    if stage not in STAGES:
        raise ValueError(f"{stage!r} is none of {', '.join(STAGES)}")
    module = importlib.import_module(f"benchmarks.{STAGES[stage]}")
    found: StageBenchmark = module.BENCHMARK
    return found


def run_benchmarks(
    stages: Sequence[str] = (),
    *,
    quick: bool = False,
    repeats: int = 1,
    budgets: bool = True,
    more_peers: Mapping[str, Sequence[Peer]] | None = None,
    on_point: Callable[[str, Point], None] = lambda stage, point: None,
    on_budget: Callable[[BudgetRow], None] = lambda row: None,
) -> BenchmarkReport:
    """Sweep the knobs of stages and check that they keep their budgets.

    Parameters
    ----------
    stages : sequence of str
        Names from `STAGES`; all when empty.
    quick : bool
        Tiny scenes and few settings: to see that it runs.
    repeats : int
        Runs of each setting and scene, of which the cheapest counts.
    budgets : bool
        Check budgets in seconds too.
    more_peers : mapping of str to sequence of Peer, optional
        By stage, beside its own.
    on_point, on_budget : callable
        Called with each row as it is done.
    """
    reports, extra = [], more_peers or {}
    for name in stages or STAGES:
        benchmark = benchmark_of(name)
        peers = tuple(extra.get(name, ()))
        points = measured(
            benchmark,
            quick=quick,
            repeats=repeats,
            on_point=lambda point, stage=name: on_point(stage, point),  # type: ignore[misc]
            more_peers=peers,
        )
        done = {point.name for point in points}
        lacking = [p for p in (*benchmark.peers(quick), *peers) if p.missing and p.name not in done]
        missing = [(p.name, p.missing) for p in lacking]
        scenes = len(benchmark.scenes(quick))
        reports.append(StageReport(name, benchmark.errors, tuple(points), scenes, tuple(missing)))
    rows = budget_rows(stages, quick=quick, on_row=on_budget) if budgets else ()
    return BenchmarkReport(tuple(reports), tuple(rows))


def write_benchmarks(report: BenchmarkReport, out: Path) -> list[Path]:
    """Write figure, tables, CSV and JSON into a folder; return their paths."""
    from benchmarks.figure import draw
    from scan2albedo.io.records import plain_json

    make_folder(out)
    write_text(out / TABLES, report.text() + "\n")
    write_text(out / CURVES, csv_text(report.stages))
    numbers = json.dumps(plain_json(report.figures()), indent=2, allow_nan=False)
    write_text(out / NUMBERS, numbers + "\n")
    if report.stages:
        draw(report.stages).savefig(out / FIGURE, dpi=130)
    return [out / name for name in (FIGURE, TABLES, CURVES, NUMBERS) if (out / name).exists()]
