"""The named extremes of models from templates."""

from stability_cases.case import Case, assert_ends_as_it_must
from stability_cases.face_model import CASES  # noqa: F401 - conftest.py runs the test once for each


def test_an_extreme_ends_as_it_must(case: Case) -> None:
    assert_ends_as_it_must(case)
