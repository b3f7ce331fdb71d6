"""Print what every stage does in its named extremes: right answer, measured warning or named error.

    python tools/stability_report.py [STAGE ...] [--quick] [--markdown]

Exit status 1 when a case ends otherwise than it must, in NaN, in a crash, or takes over `--seconds`.
"""

from __future__ import annotations

import argparse
import importlib
import pkgutil
import sys
import time
from collections.abc import Iterator

import stability_cases
from stability_cases.case import Case, Outcome, run


def all_cases() -> Iterator[Case]:
    """Yield the cases of every module of `stability_cases`."""
    for module in pkgutil.iter_modules(stability_cases.__path__):
        yield from getattr(importlib.import_module(f"stability_cases.{module.name}"), "CASES", ())


def main() -> int:
    """Run the chosen cases and print a row for each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("stages", nargs="*", help="such as fit or albedo; all when omitted")
    parser.add_argument("--quick", action="store_true", help="leave out the slow cases")
    parser.add_argument("--markdown", action="store_true", help="print a table for a page")
    parser.add_argument("--seconds", type=float, default=120.0, help="of CPU; a case that takes more hangs")
    options = parser.parse_args()
    cases = [case for case in all_cases() if not (options.quick and case.slow)]
    if unknown := set(options.stages) - {case.stage for case in cases}:
        parser.error(f"unknown stage {min(unknown)!r}; one of {', '.join(sorted({c.stage for c in cases}))}")
    chosen = [case for case in cases if not options.stages or case.stage in options.stages]
    if options.markdown:
        print("| stage | extreme | ending | figure |\n|---|---|---|---|")
    failures = [case for case in chosen if not _row(case, options.markdown, options.seconds)]
    print(f"\n{len(chosen) - len(failures)} of {len(chosen)} extremes end as they must")
    return 1 if failures else 0


def _row(case: Case, markdown: bool, seconds: float) -> bool:
    """Run a case, print its row, and return whether it ended as it must."""
    begin = time.process_time()
    try:
        outcome = run(case)
    except Exception as error:  # noqa: BLE001 - a table shows every failure, whatever it is
        outcome = Outcome("named error", f"BUG: {type(error).__name__}: {error}")
        good = False
    else:
        good = outcome.ending == case.expected
    elapsed = time.process_time() - begin
    good = good and elapsed <= seconds
    mark = "" if good else f" (FAILS: {case.expected} in {seconds:g} s expected, took {elapsed:.1f} s)"
    cells = (case.stage, case.name, outcome.ending + mark, outcome.figure.replace("|", "/"))
    if markdown:
        print(f"| {' | '.join(cells)} |", flush=True)
    else:
        print(f"{cells[0]:16} {cells[1]:44} {cells[2]:17} {cells[3]}", flush=True)
    return good


if __name__ == "__main__":
    sys.exit(main())
