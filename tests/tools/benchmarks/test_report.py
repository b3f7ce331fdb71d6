"""Tables, CSV, numbers and the figure of known points."""

import csv
import io
import json
from itertools import combinations

import numpy as np
import pytest
from benchmarks.figure import draw
from benchmarks.report import StageReport, csv_text
from benchmarks.run import BenchmarkReport, write_benchmarks
from benchmarks.sweep import OURS, ErrorKind, Point
from matplotlib.text import Text

KINDS = (ErrorKind("surface", "mm"), ErrorKind("correspondence", "mm"))


def point(name, cpu_s, *errors, method=OURS):
    knob, _, value = name.partition(" ")
    return Point(method, knob, value, errors, tuple(2 * e for e in errors), cpu_s, cpu_s, 9, {"p95 mm": 1.0})


@pytest.fixture
def report():
    points = (
        point("default", 2.0, 0.2, 1.0),
        point("steps 1", 0.2, 2.0, 4.0),
        point("steps 2", 0.4, 0.22, 2.0),
        point("steps 90", 9.0, 0.19, 1.5),
        point("preset best", 5.0, 0.195, 0.9),
        point("peer", 8.0, 0.5, 3.0, method="nricp"),
        point("peer", 0.1, 0.01, 3.0, method="oracle"),
    )
    return StageReport("fit", KINDS, points, 3, (("small_gicp", "pip install small_gicp"),))


def test_front_and_knee_are_ours_alone(report):
    assert [p.name for p in report.front(0)] == ["steps 1", "steps 2", "default", "preset best", "steps 90"]
    assert [p.name for p in report.front(1)] == ["steps 1", "steps 2", "default", "preset best"]
    assert report.knee(0).name == "steps 2"


def test_table_tells_all(report):
    table = report.table()
    rows = {line[:40].strip(): line for line in table.splitlines()[3:]}
    assert list(rows)[:3] == ["oracle", "steps 1", "steps 2"]
    assert "knee of surface, knee of correspondence" in rows["steps 2"]
    assert rows["default"].endswith("default")
    assert "preset best" in rows["preset best"]
    assert rows["nricp"].endswith("ours as good or better in 0.05 x its time")
    assert rows["oracle"].endswith("more exact than all of ours")
    assert table.endswith("not installed: small_gicp: pip install small_gicp")
    assert "means over 3 scenes" in table


def test_csv_has_a_row_for_each_point_and_kind(report):
    rows = list(csv.DictReader(io.StringIO(csv_text([report]))))
    assert len(rows) == 2 * len(report.points)
    knees = [(r["error_name"], f"{r['knob']} {r['value']}") for r in rows if r["knee"] == "1"]
    assert ("surface", "steps 2") in knees
    assert float(rows[0]["error"]) == 0.2


def test_files_are_written_and_strict(report, tmp_path):
    failed = point("steps 0", 0.1, float("nan"), float("nan"))
    bad = StageReport("fit", KINDS, (*report.points, failed))
    files = write_benchmarks(BenchmarkReport((report, bad), ()), tmp_path / "out")
    assert sorted(f.name for f in files) == [
        "benchmark.json",
        "benchmark.txt",
        "error_vs_time.csv",
        "error_vs_time.png",
    ]
    numbers = json.loads((tmp_path / "out" / "benchmark.json").read_text())
    assert numbers["stages"][0]["knee"][0] == "steps 2"
    assert numbers["stages"][1]["points"][-1]["errors"] == [None, None]
    assert (tmp_path / "out" / "error_vs_time.png").read_bytes().startswith(b"\x89PNG")


def test_figure_has_a_panel_for_each_kind_and_names_peers(report):
    figure = draw([report])
    titles = [axis.get_title() for axis in figure.axes if axis.axison]
    assert titles == ["fit: surface", "fit: correspondence"]
    written = {text.get_text() for text in figure.axes[0].texts}
    assert {"nricp", "oracle", "default", "best", "knee: steps 2"} <= written


def test_labels_of_one_place_do_not_lie_on_each_other():
    crowd = [point("peer", 1.0 + 0.01 * k, 1.0 + 0.01 * k, method=f"method {k}") for k in range(6)]
    ours = [point("default", 0.9, 1.0), point("steps 1", 0.5, 30.0)]
    figure = draw([StageReport("fit", KINDS[:1], (*ours, *crowd))])
    figure.draw_without_rendering()
    axis = figure.axes[0]
    assert sum(text.get_text().startswith("method") for text in axis.texts) == 6
    boxes = [Text.get_window_extent(text) for text in axis.texts]
    assert not any(one.overlaps(other) for one, other in combinations(boxes, 2))
    front = max(axis.lines, key=lambda line: len(line.get_xdata())).get_transform()
    line = front.transform(np.linspace((0.5, 30.0), (0.9, 1.0), 200))
    assert not any(box.contains(*place) for box in boxes for place in line)
