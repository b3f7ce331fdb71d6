"""Figure 10 of Toderici et al. on a synthetic population: who is recognised by texture, and who by albedo.

    python tools/experiment_recognition.py [-o recognition_out] [--persons 60] [--probes 3] [--size 256]
        [--individuality 0.7] [--light flashes] [--lamp-colors 0] [--brdf NAME ...] [--budget SECONDS]
        [--jobs N] [--seed 0] [--other-templates] [--json]

Scans and processes 60 persons, four times each (an hour on two cores), writes the report, and prints pairs of
reflectances beside each other. A run that was stopped goes on where it was, and one with more persons begins
with those that are done. --other-templates repeats the identification, on the same scans, with templates of
other sizes, windows and masks.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import sys
from dataclasses import replace
from pathlib import Path

from recognition_experiment import (
    RecognitionExperimentOptions,
    RecognitionReport,
    run_recognition_experiment,
)
from recognition_experiment.files import write_report

from scan2albedo.core import TraceRow
from scan2albedo.io.atomic import check_writable, removed_if_empty
from scan2albedo.io.records import plain_json
from scan2albedo.recognition import TemplateOptions
from scan2albedo.recognition.similarity import WINDOW

OTHER_TEMPLATES = {
    "as it is": (TemplateOptions(), WINDOW),
    "window 5": (TemplateOptions(), 5),
    "window 7": (TemplateOptions(), 7),
    "128 texels": (TemplateOptions(size=128), WINDOW),
    "128 texels, window 5": (TemplateOptions(size=128), 5),
}


def print_pairs(report: RecognitionReport) -> None:
    albedos = [result for result in report.results if result.method.startswith("albedo")]
    print("\nalbedos beside each other (probes that only one identifies, McNemar's p):")
    for a, b in itertools.combinations(albedos, 2):
        only_a, only_b, p = a.against(b)
        print(f"  {a.method:28} {only_a:4} : {only_b:<4} {b.method:28} p {p:.2g}")


def print_other_templates(cache: Path, options: RecognitionExperimentOptions) -> None:
    print("\nrank 1 by other templates on the same scans:")
    for number, (name, (templates, window)) in enumerate(OTHER_TEMPLATES.items()):
        chosen = replace(options, templates=templates, window=window)
        results = run_recognition_experiment(cache, options=chosen).results
        if number == 0:
            print(
                " " * 24 + "".join(f"{result.method.removeprefix('albedo, '):>21.19}" for result in results)
            )
        print(f"  {name:22}" + "".join(f"{result.rank_1:21.1%}" for result in results), flush=True)


def show(row: TraceRow) -> None:
    print(f"{row.evaluations} scans, {row.elapsed_s:.0f} s: rank-1 errors {row.error:.1%}", file=sys.stderr)


def parser() -> argparse.ArgumentParser:
    raw = argparse.RawDescriptionHelpFormatter
    made = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    made.add_argument("-o", "--out", type=Path, default=Path("recognition_out"), help="keeps the scans, too")
    made.add_argument("--persons", type=int, default=60)
    made.add_argument("--probes", type=int, default=3, help="scans of each person beside the gallery's")
    made.add_argument("--size", type=int, default=256, help="side of the geometry images, 128 or more")
    made.add_argument("--individuality", type=float, help="part of the skin's paint of one's own, 0 to 1")
    made.add_argument(
        "--light", choices=("flashes", "room"), default="flashes", help="room: soft light and a weak lamp"
    )
    made.add_argument(
        "--lamp-colors",
        type=float,
        help="deviation of log red and blue of each lamp; 0: white; 0.3 in a room, else 0 when omitted",
    )
    made.add_argument("--brdf", action="append", help="a reflectance, repeatable; all when omitted")
    made.add_argument("--budget", type=float, help="seconds; then report who is complete")
    made.add_argument("--jobs", type=int, default=0, help="processes; 0 for one a core")
    made.add_argument("--seed", type=int, default=0, help="of the population")
    made.add_argument("--other-templates", action="store_true", help="identify with other templates, too")
    made.add_argument("--json", action="store_true", help="print all figures as JSON on stdout")
    return made


def options_of(arguments: argparse.Namespace) -> RecognitionExperimentOptions:
    """Return the options of a command line; a ValueError names what is out of range."""
    if arguments.budget is not None and not arguments.budget > 0:
        raise ValueError(f"budget is {arguments.budget}, expected seconds above 0")
    options = RecognitionExperimentOptions(
        persons=arguments.persons, probes=arguments.probes, size=arguments.size, seed=arguments.seed
    )
    colors = arguments.lamp_colors
    if colors is None:
        colors = 0.3 if arguments.light == "room" else 0.0
    crowd = replace(options.population, light=arguments.light, lamp_colors=colors)
    if arguments.individuality is not None:
        crowd = replace(crowd, individuality=arguments.individuality)
    return replace(options, population=crowd, brdfs=tuple(arguments.brdf or options.brdfs))


def main(words: list[str] | None = None) -> None:
    arguments = parser().parse_args(words)
    try:
        options = options_of(arguments)
    except ValueError as error:
        parser().error(str(error))
    cache, jobs = arguments.out / "scans", arguments.jobs or os.cpu_count() or 1
    with removed_if_empty(arguments.out):
        check_writable(arguments.out)
        report = run_recognition_experiment(
            cache, options=options, budget=arguments.budget, jobs=jobs, on_progress=show
        )
    write_report(report, arguments.out, cache)
    print(f"files in {arguments.out}", file=sys.stderr)
    if arguments.json:
        print(json.dumps(plain_json(report.figures()), indent=2))
        return
    print(report.table())
    print_pairs(report)
    if arguments.other_templates:
        print_other_templates(cache, options)


if __name__ == "__main__":
    main()
