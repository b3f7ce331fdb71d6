"""Every extreme ends as it must, and shows how; the page's table lists exactly the extremes there are."""

import pytest
from stability_report import all_cases

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
