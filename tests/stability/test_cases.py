"""Every extreme ends as it must, and shows how; the page's table lists exactly the extremes there are."""

from pathlib import Path

import pytest
from stability_report import all_cases, read

from stability.case import run

CASES = list(all_cases())


@pytest.mark.parametrize(
    "case", [pytest.param(c, id=str(c), marks=[pytest.mark.slow] * c.slow) for c in CASES]
)
def test_an_extreme_ends_as_it_must(case):
    outcome = run(case)
    assert outcome.ending == case.ends_in, outcome.figure


def test_names_are_told_apart():
    assert len({str(case) for case in CASES}) == len(CASES)


def test_the_page_lists_exactly_the_extremes_there_are():
    page = Path(__file__).resolve().parents[2] / "docs" / "stability.csv"
    listed = [(row["stage"], row["extreme"], row["ends in"]) for row in read(page)]
    assert listed == [(case.stage, case.name, case.ends_in) for case in CASES]
