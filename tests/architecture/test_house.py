"""The package does not grow: `tools/house.py` against `ceilings.json`."""

import json
from collections import Counter

import house
import pytest


@pytest.fixture(scope="module")
def found():
    return house.totals(house.figures())


def test_no_figure_rises_above_its_ceiling(found):
    assert house.risen(found, json.loads(house.CEILINGS.read_text())) == []


def test_a_figure_that_rises_is_named(found):
    ceilings = found | {"constants": found["constants"] - 1}
    assert [fault.split(":")[0] for fault in house.risen(found, ceilings)] == ["constants"]


def test_each_column_counts_what_it_says(tmp_path):
    package = tmp_path / "scan2albedo" / "light"
    package.mkdir(parents=True)
    (package / "lamp.py").write_text(
        '"""Doc."""\n'
        "from dataclasses import dataclass\n\n"
        "_LIMIT = 0.25\n"
        "_NAMES = ('a', 'b')\n"
        "_LOW, _HIGH = 1, 2\n\n"
        "@dataclass\n"
        "class LampOptions:\n"
        '    """Doc."""\n'
        "    size: int = 3\n"
        "    unused: int = 4\n\n"
        "def _helper(x):  # a comment\n"
        "    return x * 0.3 + 0.5\n\n"
        "def lamp():\n"
        "    return _helper(LampOptions(size=2))\n"
    )
    lines = {"lines": 18, "code": 12, "modules": 1, "types": 1}
    numbers = {"constants": 3, "literals": 1, "once": 1, "options": 2, "unset": 1}
    assert house.figures(tmp_path) == {"light": Counter(lines | numbers)}
