"""The named extremes of the applications."""

from stability_cases.applications import CASES  # noqa: F401 - conftest.py runs the test once for each
from stability_cases.case import Case, assert_ends_as_it_must


def test_an_extreme_ends_as_it_must(case: Case) -> None:
    assert_ends_as_it_must(case)
