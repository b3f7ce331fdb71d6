"""The runner on benches made up for the test, and what its command writes."""

import json
import sys
import types
from dataclasses import replace

import numpy as np
import pytest
from bench import registry
from bench.command import main
from bench.runner import ALL, CPU, Bar, Bench, Case, Timed, run, summarised

from scan2albedo.errors import EyeglassesError


def refuse(scene):
    raise EyeglassesError("too coarse")


def lacking(scene):
    raise ModuleNotFoundError("No module named 'absent'")


MADE_UP = Bench(
    lambda quick: [Case(f"scene {k}", lambda k=k: float(k), "odd" if k % 2 else "even") for k in (1, 2, 3)],
    methods={"default": lambda scene: Timed(scene / 2, 2.0), "effort 4": lambda scene: Timed(scene / 4, 4.0)},
    peers={"slow": lambda scene: Timed(scene, 10.0), "coarse": refuse, "absent": lacking},
    score=lambda scene, answer: {"error": answer, "twice": 2 * answer, "steps": "7 steps"},
    slow=("slow",),
    quick=("default",),
)


def test_rows_carry_scores_words_cpu_and_refusals():
    rows = list(run(MADE_UP, only=["scene 1"]))
    assert [row.method for row in rows] == ["default", "effort 4", "coarse", "absent"]
    assert rows[0].values == {"error": 0.5, "twice": 1.0, CPU: 2.0}
    assert (rows[0].note, rows[0].failed) == ("7 steps", False)
    assert [(row.note, row.failed) for row in rows[2:]] == [
        ("too coarse", True),
        ("No module named 'absent'", True),
    ]


def test_summaries_are_of_groups_and_of_all():
    summary = summarised(list(run(MADE_UP)))
    assert list(summary) == ["odd", "even", ALL]
    default = summary["odd"]["default"]
    assert (default["n"]["error"], default["least"]["error"], default["mean"]["error"]) == (2, 0.5, 1.0)
    assert (default["worst"]["error"], summary[ALL]["default"]["median"]["error"]) == (1.5, 1.0)
    assert "coarse" not in summary[ALL]


def test_numbers_that_are_not_finite_do_not_count():
    bench = replace(MADE_UP, score=lambda scene, answer: {"error": answer if scene > 1 else np.nan})
    figures = summarised(list(run(bench, quick=True)))[ALL]["default"]
    assert (figures["n"]["error"], figures["mean"]["error"]) == (2, 1.25)


def test_slow_methods_run_by_name_and_an_unknown_one_is_named():
    assert list(MADE_UP.chosen(("slow",), True)) == ["slow"]
    with pytest.raises(ValueError, match="'hair' is none of the methods default, effort 4"):
        list(run(MADE_UP, methods=["hair"]))


def test_of_repeats_the_cheapest_counts_and_warming_up_counts_none():
    costs = iter([1.0, 5.0, 3.0, 9.0])
    bench = replace(MADE_UP, methods={"only": lambda scene: Timed(0.0, next(costs))}, peers={}, warm=True)
    (row,) = run(replace(bench, repeats=3), only=["scene 1"])
    assert row.values[CPU] == 3.0


def test_missing_data_are_said():
    def no_folder(quick):
        raise FileNotFoundError("../shared/data/none")

    (row,) = run(replace(MADE_UP, cases=no_folder))
    assert row.failed
    assert "../shared/data/none" in row.note


@pytest.mark.parametrize(
    ("bar", "kept"),
    [
        (Bar("made", "default", "mean", "error", at_most=1.0), True),
        (Bar("made", "default", "mean", "error", at_most=0.9), False),
        (Bar("made", "default", "worst", "error", group="odd", at_least=1.5), True),
        (Bar("made", "absent", "mean", "error", at_most=1.0), False),
    ],
)
def test_bars_are_kept_broken_or_not_measured(bar, kept):
    assert bar.verdict(summarised(list(run(MADE_UP))))[0] is kept


@pytest.fixture
def made_up(monkeypatch, tmp_path):
    """The bench as a file of the folder, with one bar for quick runs and a broken one for whole runs."""
    module = types.ModuleType("bench.made")
    module.BENCHES = {"up": MADE_UP}
    monkeypatch.setitem(sys.modules, "bench.made", module)
    (tmp_path / "made.py").write_text('"""Numbers halved."""\nBENCHES = {}\n')
    one = {"bench": "made/up", "method": "default", "summary": "mean", "column": "error"}
    bars = [{**one, "at_most": 1.0}, {**one, "quick": False, "at_most": 0.5}]
    (tmp_path / "bars.json").write_text(json.dumps(bars))
    monkeypatch.setattr(registry, "FOLDER", tmp_path)
    monkeypatch.setattr(registry, "BARS", tmp_path / "bars.json")
    return tmp_path


def test_the_command_lists_benches(made_up, capsys):
    assert main([]) == 0
    assert capsys.readouterr().out.split() == ["made", "Numbers", "halved."]


def test_the_command_writes_rows_summaries_and_a_picture(made_up, capsys):
    record, picture = made_up / "out.json", made_up / "out.png"
    assert main(["made", "--quick", "--check", "--json", str(record), "--figure", str(picture)]) == 0
    printed = capsys.readouterr().out
    assert "made/up: mean error of default, all cases: 1, at most 1" in printed
    written = json.loads(record.read_text())["made/up"]
    assert [row["case"] for row in written["rows"]] == ["scene 1", "scene 2", "scene 3"]
    assert written["summary"]["all"]["default"]["worst"]["error"] == 1.5
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_a_broken_bar_is_exit_status_1(made_up, capsys):
    assert main(["made/up", "--check"]) == 1
    assert "BROKEN" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["hair", "made/hair"])
def test_an_unknown_bench_is_named(made_up, name):
    with pytest.raises(ValueError, match=f"'{name}' is none of made"):
        main([name])
