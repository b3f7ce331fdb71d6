"""The named extremes of the light that the albedo stage takes off."""

from stability_cases.case import Case, assert_ends_as_it_must
from stability_cases.soft_light import CASES  # noqa: F401 - conftest.py runs the test once for each


def test_an_extreme_ends_as_it_must(case: Case) -> None:
    assert_ends_as_it_must(case)
