"""There is no more to read than before: `tools/house.py` against `ceilings.json`."""

import json

import house
import pytest

WHY = """
`python tools/house.py` shows the folders and explains the columns.
The ceilings keep the project small enough to be read by people who did not write it; they count tokens of
code, so packing lines lowers nothing.
Take out as much as you add (code that nobody needs, an idea that is written twice), split the function that
grew where a reader would pause, or ask in the pull request what may go in exchange."""


def test_no_figure_rises_above_its_ceiling():
    faults = house.risen(house.figures(), json.loads(house.CEILINGS.read_text()))
    assert not faults, "\n".join(faults) + WHY


def test_every_option_is_set_somewhere():
    assert house.unset_options() == []


def test_a_figure_that_rises_is_named():
    table = {"tools": house.Counter(tokens=11, packed=1)}
    faults = house.risen(table, {"tools": {"tokens": 10, "packed": 1}})
    assert faults == ["tools: tokens 11, at most 10 allowed"]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('"""Doc."""\nX = 0.5  # a comment\n', {"tokens": 3, "fractions": 1}),
        ('A, B = 1, 2\n"""Doc."""\n', {"tokens": 7, "packed": 1}),
        ("def f(x):\n    a, b = x, 2.0\n", {"tokens": 13, "packed": 1}),
        ("a, b = b, a\n", {"tokens": 7}),
        ("x = [1,\n 2]  # fmt: " + "skip\n", {"tokens": 7, "fmt_skips": 1}),
        ("def f():\n" + "    x = 1\n" * 167, {"tokens": 506, "over_500": 1}),
        ("def f():\n" + "    x = 1\n" * 334, {"tokens": 1007, "over_500": 1, "over_1000": 1}),
    ],
)
def test_each_column_counts_what_it_says(text, expected):
    assert +house.measured(text) == expected


def test_the_package_is_counted_by_folder(tmp_path):
    for name in ("scan2albedo/light/lamp.py", "scan2albedo/errors.py", "tests/test_lamp.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("x = 1\n")
    counted = {name: row["tokens"] for name, row in house.figures(tmp_path).items()}
    assert counted == {"scan2albedo": 6, "scan2albedo/light": 3, "tools": 0, "tests": 3}
