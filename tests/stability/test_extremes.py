"""Every named extreme of every stage ends in a right answer, a measured warning or a named error."""

from __future__ import annotations

import pytest
from stability_cases.case import Case, run
from stability_report import all_cases


@pytest.mark.parametrize(
    "case",
    [pytest.param(case, id=str(case), marks=[pytest.mark.slow] if case.slow else []) for case in all_cases()],
)
def test_an_extreme_ends_as_it_must(case: Case) -> None:
    outcome = run(case)
    assert outcome.ending == case.expected, outcome.figure
    assert outcome.figure, "a figure or a message must show what happened"
