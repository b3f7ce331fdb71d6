"""Budgets, meters and traces."""

import csv
import io
import itertools
import math

import pytest

from scan2albedo.core import Budget, Meter, Trace, TraceRow


def test_a_number_means_seconds_and_none_means_no_limit():
    assert Budget.of(3) == Budget(seconds=3.0)
    assert Budget.of(None) == Budget()
    budget = Budget(evaluations=7)
    assert Budget.of(budget) is budget


@pytest.mark.parametrize(
    ("name", "wrong", "expected"),
    [
        *(("seconds", wrong, "a number > 0") for wrong in (0, -1, math.nan)),
        *(("evaluations", wrong, "a whole number >= 1") for wrong in (0, 2.5, math.nan)),
    ],
)
def test_limits_are_above_zero(name, wrong, expected):
    with pytest.raises(ValueError, match=f"Budget.{name} must be {expected}, got {wrong}"):
        Budget(**{name: wrong})


def test_a_meter_is_exhausted_by_evaluations_and_runs_out_of_time_by_seconds():
    meter = Meter("fit", "mm", Budget(evaluations=5))
    meter.count(4)
    assert not meter.exhausted
    meter.count()
    assert meter.exhausted
    assert not meter.out_of_time
    assert not Meter("fit", "mm").exhausted
    assert Meter("fit", "mm", Budget(seconds=1e-9)).out_of_time
    assert not Meter("fit", "mm", Budget(seconds=1e9, evaluations=1)).out_of_time


def test_meter_records_rows_and_tells_the_caller():
    heard = []
    meter = Meter("fit", "mm", Budget(), heard.append)
    for evaluations, error in ((1, 2.0), (2, 1.0)):
        meter.count(evaluations)
        meter.record(error)
    assert [row.evaluations for row in meter.trace] == [1, 3]
    assert [row.error for row in heard] == [2.0, 1.0]
    assert meter.trace.rows[1].elapsed_s >= meter.trace.rows[0].elapsed_s


def test_trace_joins_selects_writes_and_draws(tmp_path):
    first = Trace((TraceRow("register", 0.1, 0.1, 3, 5.0, "mm"),))
    trace = first + Trace((TraceRow("fit", 0.2, 0.3, 9, 0.5, "mm"),))
    assert trace.stages == ("register", "fit")
    assert trace.of_stage("fit").rows[0].error == 0.5
    text = trace.to_csv(tmp_path / "trace.csv")
    assert (tmp_path / "trace.csv").read_text() == text
    rows = list(csv.DictReader(io.StringIO(text)))
    assert [row["stage"] for row in rows] == ["register", "fit"]
    assert float(rows[1]["error"]) == 0.5
    assert len(trace.plot().axes) == 2


def test_a_sub_meter_has_what_is_left_and_its_work_is_merged():
    meter = Meter("albedo", "cost", Budget(evaluations=10))
    meter.count(4)
    inner = meter.sub_meter("annealing", "cost")
    assert inner.budget.evaluations == 6
    inner.count(6)
    inner.record(0.5)
    assert inner.exhausted
    meter.merge(inner)
    assert meter.exhausted
    assert meter.trace.stages == ("annealing",)


def rows_of(stage, times_s, errors):
    return tuple(
        TraceRow(stage, t, t, k, error, "mm")
        for k, (t, error) in enumerate(zip(times_s, errors, strict=True), 1)
    )


def test_many_stages_are_drawn():
    figure = Trace(sum((rows_of(f"stage {i}", [1.0, 2.0], [0.2, 0.1]) for i in range(8)), ())).plot()
    assert sum(bool(axis.lines) for axis in figure.axes) == 8
    assert figure.get_figwidth() < 30


@pytest.mark.parametrize("start_s", [0.00063, 9.026, 123.0])
def test_labels_of_times_do_not_overlap(start_s):
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    times = [start_s + step for step in (0.0, 1e-6, 2e-5, 0.00007)]
    figure = Trace(rows_of("short", times, [4.0, 3.9, 3.8, 3.7])).plot()
    FigureCanvasAgg(figure).draw()
    (axis,) = figure.axes
    boxes = [label.get_window_extent() for label in axis.get_xticklabels() if label.get_text()]
    inside = [box for box in boxes if axis.bbox.x0 <= (box.x0 + box.x1) / 2 <= axis.bbox.x1]
    assert len(inside) > 1
    assert all(a.x1 < b.x0 for a, b in itertools.pairwise(inside))


def test_runs_of_one_stage_are_drawn_apart():
    first, second = rows_of("fit", [0.1, 2.0], [9.0, 5.0]), rows_of("fit", [0.2, 0.3, 1.0], [6.0, 4.0, 3.0])
    trace = Trace(first + second)
    assert [run.rows for run in trace.runs()] == [first, second]
    (axis,) = trace.plot().axes
    assert [line.get_xdata().tolist() for line in axis.lines] == [[0.1, 2.0], [0.2, 0.3, 1.0]]
    assert [text.get_text() for text in axis.get_legend().get_texts()] == ["run 1", "run 2"]
    (axis,) = Trace(first).plot().axes
    assert axis.get_legend() is None
