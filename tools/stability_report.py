"""Print what every stage does in its named extremes: right answer, measured warning or named error.

    python tools/stability_report.py [STAGE ...] [--quick]
    python tools/stability_report.py --write docs/stability.md    # the summary below its marker, and the CSV

The cases are the tables of tests/stability. With stages or `--quick`, `--write` leaves the other rows of the
CSV as they are. Exit status 1 when a case ends otherwise than it must, in NaN, in a crash, or takes over
`--seconds`.
"""

import argparse
import csv
import importlib
import pkgutil
import re
import sys
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import stability
from stability.case import REFUSES, RIGHT, WARNS, run

MARKER = "<!-- below: written by tools/stability_report.py -->"
COLUMNS = ("stage", "extreme", "ends in", "what shows it")
WORST = {
    "albedo": r"albedo off by ([\d.]+) %",
    "fit": r"^([\d.]+) mm",
    "load_scan": r"(?<=degrees, )([\d.]+) mm off",
    "process": r"landmarks ([\d.]+) mm off",
    "reflectance": r"albedo off by ([\d.]+) %",
    "register": r"([\d.]+) mm off",
}
"""What in a right answer's figure says how far it is off, in the stages that have one such number."""


def all_cases() -> Iterator[Any]:
    """Yield the cases of every table of tests/stability."""
    for module in pkgutil.iter_modules(stability.__path__):
        if not module.name.startswith("test_"):
            yield from getattr(importlib.import_module(f"stability.{module.name}"), "CASES", ())


def main() -> int:
    """Run the chosen cases and print a row for each, or write them into a page and its CSV."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("stages", nargs="*", help="such as fit or albedo; all when omitted")
    parser.add_argument("--quick", action="store_true", help="leave out the slow cases")
    parser.add_argument(
        "--write", type=Path, help="a page; its summary and the CSV beside it are written anew"
    )
    parser.add_argument("--seconds", type=float, default=120.0, help="of CPU; a case that takes more hangs")
    options = parser.parse_args()
    cases = list(all_cases())
    if unknown := set(options.stages) - {case.stage for case in cases}:
        parser.error(f"unknown stage {min(unknown)!r}; one of {', '.join(sorted({c.stage for c in cases}))}")
    bad = 0
    rows = {}
    for case in cases:
        if (options.stages and case.stage not in options.stages) or (options.quick and case.slow):
            continue
        ending, figure = ended(case, options.seconds)
        print(f"{case.stage:16} {case.name:44} {ending:17} {figure}", flush=True)
        bad += ending != case.ends_in
        rows[case.stage, case.name] = (ending, figure)
    print(f"\n{len(rows) - bad} of {len(rows)} extremes end as they must")
    if options.write is not None:
        write(options.write, cases, rows)
    return 1 if bad else 0


def ended(case: Any, seconds: float) -> tuple[str, str]:
    """Return how a case ended, and its figure; whatever it ends in is a row."""
    begin = time.process_time()
    try:
        outcome = run(case)
    except Exception as error:  # noqa: BLE001 - a table shows every failure, whatever it is
        return f"FAILS: {type(error).__name__}", str(error)
    if time.process_time() - begin > seconds:
        return "FAILS: too slow", outcome.figure
    return outcome.ending, outcome.figure


def write(page: Path, cases: Iterable[Any], new: dict[tuple[str, str], tuple[str, str]]) -> None:
    """Write the CSV beside a page, rows that are not new as they were, and the page's summary."""
    table = page.with_suffix(".csv")
    old = {(row["stage"], row["extreme"]): (row["ends in"], row["what shows it"]) for row in read(table)}
    rows = [
        (
            case.stage,
            case.name,
            *(new | {k: v for k, v in old.items() if k not in new})[case.stage, case.name],
        )
        for case in cases
    ]
    with table.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([COLUMNS, *rows])
    good = sum(row[2] == case.ends_in for row, case in zip(rows, cases, strict=True))
    intro, _, _ = page.read_text(encoding="utf-8").partition(MARKER)
    verdict = f"{good} of {len(rows)} extremes end as they must."
    page.write_text(f"{intro}{MARKER}\n\n{verdict}\n\n{summary(rows)}", encoding="utf-8")


def read(table: Path) -> list[dict[str, str]]:
    """Return the rows of the CSV."""
    if not table.is_file():
        return []
    with table.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def summary(rows: list[tuple[str, str, str, str]]) -> str:
    """Return a Markdown table with a row a stage: how many end how, and the worst right answer."""
    text = "| stage | right | warned | refused | the worst right answer |\n|---|---|---|---|---|\n"
    for stage in sorted({row[0] for row in rows}):
        of_stage = [row for row in rows if row[0] == stage]
        counts = [str(sum(row[2] == ending for row in of_stage)) for ending in (RIGHT, WARNS, REFUSES)]
        text += f"| {stage} | {' | '.join(counts)} | {worst(of_stage)} |\n"
    return text


def worst(rows: list[tuple[str, str, str, str]]) -> str:
    """Return the figure and the name of the right answer that is furthest off; nothing without a measure."""
    pattern = WORST.get(rows[0][0])
    found = [
        (float(match[1]), match[0].removeprefix("albedo "), name)
        for _, name, ending, figure in rows
        if pattern is not None and ending == RIGHT and (match := re.search(pattern, figure))
    ]
    return f"{max(found)[1]} ({max(found)[2]})" if found else ""


if __name__ == "__main__":
    sys.exit(main())
