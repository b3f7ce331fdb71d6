"""Print what every stage does in its named extremes: right answer, measured warning or named error.

    python tools/stability_report.py [STAGE ...] [--quick]
    python tools/stability_report.py --page docs/stability.md    # the page's tables anew, below its marker

Exit status 1 when a case ends otherwise than it must, in NaN, in a crash, or takes over `--seconds`.
"""

from __future__ import annotations

import argparse
import importlib
import pkgutil
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import stability_cases
from stability_cases.case import Case, Outcome, run

MARKER = "<!-- below: written by tools/stability_report.py -->"


def all_cases() -> Iterator[Case]:
    """Yield the cases of every module of `stability_cases`."""
    for module in pkgutil.iter_modules(stability_cases.__path__):
        yield from getattr(importlib.import_module(f"stability_cases.{module.name}"), "CASES", ())


def main() -> int:
    """Run the chosen cases and print a row for each, or write them all into a page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("stages", nargs="*", help="such as fit or albedo; all when omitted")
    parser.add_argument("--quick", action="store_true", help="leave out the slow cases")
    parser.add_argument("--page", type=Path, help="a page whose tables are written anew below its marker")
    parser.add_argument("--seconds", type=float, default=120.0, help="of CPU; a case that takes more hangs")
    options = parser.parse_args()
    cases = [case for case in all_cases() if not (options.quick and case.slow)]
    if unknown := set(options.stages) - {case.stage for case in cases}:
        parser.error(f"unknown stage {min(unknown)!r}; one of {', '.join(sorted({c.stage for c in cases}))}")
    chosen = [case for case in cases if not options.stages or case.stage in options.stages]
    rows = []
    for case in chosen:
        rows.append(ended(case, options.seconds))
        print(rows[-1].line(), flush=True)
    good = sum(row.good for row in rows)
    verdict = f"{good} of {len(rows)} extremes end as they must"
    print(f"\n{verdict}")
    if options.page is not None:
        intro, _, _ = options.page.read_text(encoding="utf-8").partition(MARKER)
        options.page.write_text(f"{intro}{MARKER}\n\n{verdict}.\n{tables(rows)}", encoding="utf-8")
    return 0 if good == len(rows) else 1


@dataclass(frozen=True)
class Row:
    """A case, how it ended, and whether it had to."""

    case: Case
    outcome: Outcome
    good: bool

    @property
    def ending(self) -> str:
        return self.outcome.ending if self.good else f"{self.outcome.ending} (FAILS: {self.case.expected})"

    def line(self) -> str:
        return f"{self.case.stage:16} {self.case.name:44} {self.ending:17} {self.outcome.figure}"


def ended(case: Case, seconds: float) -> Row:
    """Run a case; whatever it ends in is a row."""
    begin = time.process_time()
    try:
        outcome = run(case)
    except Exception as error:  # noqa: BLE001 - a table shows every failure, whatever it is
        return Row(case, Outcome("named error", f"BUG: {type(error).__name__}: {error}"), False)
    in_time = time.process_time() - begin <= seconds
    return Row(case, outcome, in_time and outcome.ending == case.expected)


def tables(rows: Sequence[Row]) -> str:
    """Return a heading and a Markdown table for each stage."""
    text = ""
    for stage in dict.fromkeys(row.case.stage for row in rows):
        text += f"\n## {stage}\n\n| extreme | ends in | what shows it |\n|---|---|---|\n"
        for row in (row for row in rows if row.case.stage == stage):
            cells = (row.case.name, row.ending, row.outcome.figure)
            text += f"| {' | '.join(map(_cell, cells))} |\n"
    return text


def _cell(text: str) -> str:
    """Return text that Markdown shows as it is, in one cell."""
    shown = " ".join(text.split())
    for sign in "\\`*_<>[]|":
        shown = shown.replace(sign, f"\\{sign}")
    return shown


if __name__ == "__main__":
    sys.exit(main())
