"""The recognition experiment in full, and what its choices are worth.

    python tools/experiment_recognition.py [-o recognition_out] [--persons 60] [--probes 3] [--lamp-colors 0]
                                           [--jobs 2] [--choices]

Scans and processes 60 persons, four times each (an hour on two cores; a run that was stopped goes on), writes
the report, and prints pairs of reflectances beside each other. --choices repeats the identification, on the
same scans, with templates of other sizes, windows and masks.
"""

from __future__ import annotations

import argparse
import itertools
import os
import sys
from dataclasses import replace
from pathlib import Path

from scan2albedo.core import TraceRow
from scan2albedo.experiments.recognition import (
    RecognitionExperimentOptions,
    RecognitionReport,
    run_recognition_experiment,
)
from scan2albedo.experiments.recognition.files import write_report
from scan2albedo.recognition import IDENTIFICATION, SimilarityOptions, TemplateOptions

CHOICES = {
    "as it is": (TemplateOptions(), IDENTIFICATION),
    "window 5": (TemplateOptions(), SimilarityOptions(window=5)),
    "window 7": (TemplateOptions(), SimilarityOptions(window=7)),
    "holes stay": (TemplateOptions(hole_radius=0), IDENTIFICATION),
    "V": (TemplateOptions(channel="value"), IDENTIFICATION),
    "256 texels": (TemplateOptions(size=256), IDENTIFICATION),
    "256 texels, window 5": (TemplateOptions(size=256), SimilarityOptions(window=5)),
    "256 texels, 4 scales": (TemplateOptions(size=256, scales=4), IDENTIFICATION),
}


def print_pairs(report: RecognitionReport) -> None:
    albedos = [result for result in report.results if result.method.startswith("albedo")]
    print("\nalbedos beside each other (probes that only one identifies, McNemar's p):")
    for a, b in itertools.combinations(albedos, 2):
        only_a, only_b, p = a.against(b)
        print(f"  {a.method:28} {only_a:4} : {only_b:<4} {b.method:28} p {p:.2g}")


def print_choices(cache: Path, options: RecognitionExperimentOptions) -> None:
    print("\nrank 1 by other templates on the same scans:")
    for number, (name, (templates, similarity)) in enumerate(CHOICES.items()):
        chosen = replace(options, templates=templates, similarity=similarity)
        results = run_recognition_experiment(cache, options=chosen).results
        if number == 0:
            print(
                " " * 24 + "".join(f"{result.method.removeprefix('albedo, '):>21.19}" for result in results)
            )
        print(f"  {name:22}" + "".join(f"{result.rank_1:21.1%}" for result in results), flush=True)


def show(row: TraceRow) -> None:
    print(f"{row.evaluations} scans, {row.elapsed_s:.0f} s: rank-1 errors {row.error:.1%}", file=sys.stderr)


def main() -> None:
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("-o", "--out", type=Path, default=Path("recognition_out"))
    parser.add_argument("--persons", type=int, default=60)
    parser.add_argument("--probes", type=int, default=3)
    parser.add_argument(
        "--lamp-colors", type=float, default=0.0, help="deviation of log red and blue of each lamp; 0: white"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the population")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--choices", action="store_true", help="identify with other templates, too")
    arguments = parser.parse_args()
    options = RecognitionExperimentOptions(
        persons=arguments.persons, probes=arguments.probes, seed=arguments.seed
    )
    crowd = replace(options.population, lamp_colors=arguments.lamp_colors)
    options = replace(options, population=crowd)
    cache = arguments.out / "scans"
    report = run_recognition_experiment(cache, options=options, jobs=arguments.jobs, on_progress=show)
    write_report(report, arguments.out, cache)
    print(report.table())
    print_pairs(report)
    if arguments.choices:
        print_choices(cache, options)


if __name__ == "__main__":
    main()
