"""Every module of extremes has its test file here."""

import pkgutil
from pathlib import Path

import stability_cases
from stability_report import all_cases

NO_STAGE = {"case", "scanned_person"}


def test_every_stage_has_its_file():
    modules = {module.name for module in pkgutil.iter_modules(stability_cases.__path__)} - NO_STAGE
    files = {path.stem.removeprefix("test_") for path in Path(__file__).parent.glob("test_*.py")}
    assert files - {"cases"} == modules


def test_names_are_told_apart():
    names = [str(case) for case in all_cases()]
    assert len(names) > 500
    assert len(set(names)) == len(names)
