"""Each file's tests run once for every case of its `CASES`."""

import pytest


def pytest_generate_tests(metafunc):
    if "case" in metafunc.fixturenames:
        marks = {True: [pytest.mark.slow], False: []}
        cases = [pytest.param(c, id=str(c), marks=marks[c.slow]) for c in metafunc.module.CASES]
        metafunc.parametrize("case", cases)
