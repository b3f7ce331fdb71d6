"""When a trace had gained enough, and whether a stage kept its budget."""

import math
import time

import pytest
from benchmarks.budgets import (
    BudgetedStage,
    BudgetRow,
    budget_table,
    checked_budgets,
    time_of_gain,
)

from scan2albedo.core import TraceRow


def rows(*points, stage="fit", unit="mm"):
    return [(t, TraceRow(stage, t, t, k, error, unit)) for k, (t, error) in enumerate(points)]


def test_gain_of_one_measure():
    assert time_of_gain(rows((0.1, 10.0), (0.2, 5.0), (0.3, 1.1), (0.9, 1.0))) == 0.3


def test_the_last_measure_of_some_rows_decides():
    trace = [*rows((0.1, 9), (0.2, 1), (0.3, 1), stage="icp"), *rows((0.5, 4), (0.6, 3), stage="tight_icp")]
    assert time_of_gain(trace) == 0.2
    assert time_of_gain(rows((1, 1e-2), (2, 1e-3), (3, 1e-6), (4, 1e-7))) == 4
    assert time_of_gain([*trace, *rows((0.7, 2.0), stage="tight_icp")]) == 0.7


def test_no_rows_no_time():
    assert time_of_gain([]) == math.inf
    assert time_of_gain(rows((0.1, math.nan))) == math.inf


def row(**changes):
    values = {
        "stage": "fit",
        "unit": "mm",
        "budget_s": 1.0,
        "knee": True,
        "wall_s": 1.1,
        "cpu_s": 1.1,
        "error": 1.0,
        "full_error": 0.5,
        "start_error": 10.5,
    }
    return BudgetRow(**{**values, **changes})


def test_share_and_overrun():
    assert row().share == pytest.approx(0.95)
    assert row().overrun_s == pytest.approx(0.1)
    assert row(wall_s=3.0, cpu_s=1.5).overrun_s == pytest.approx(1.0)
    assert row(wall_s=0.5).overrun_s == 0
    assert row(start_error=0.5, error=0.5).share == 1.0
    assert row(start_error=0.5).share == 0.0
    assert row(start_error=math.nan).share == 0.0


@pytest.mark.parametrize(
    ("changes", "kept"),
    [
        ({}, True),
        ({"error": 2.0}, False),
        ({"error": 2.0, "knee": False}, True),
        ({"wall_s": 1.4, "cpu_s": 1.4}, False),
        ({"wall_s": 1.4, "cpu_s": 0.7}, True),
        ({"budget_s": 10.0, "wall_s": 11.9, "cpu_s": 11.9}, True),
    ],
)
def test_kept(changes, kept):
    assert row(**changes).kept is kept
    assert budget_table([row(**changes)]).endswith("NOT KEPT") is not kept


def obedient(budget, on_progress):
    """Halve an error of 8 every 10 ms until it is 0.01 or the budget ends."""
    begin, error = time.perf_counter(), 8.0
    while error > 0.01 and (budget is None or time.perf_counter() - begin < budget):
        time.sleep(0.01)
        error /= 2
        if on_progress is not None:
            now = time.perf_counter() - begin
            on_progress(TraceRow("made up", now, now, 1, error, "mm"))
    return error


def test_a_stage_is_run_to_its_knee_and_within_tiny_budgets():
    found = checked_budgets(BudgetedStage("made up", "mm", obedient, float, 8.0), (0.02,), repeats=1)
    assert [r.knee for r in found] == [True, False]
    assert found[0].budget_s < 0.2
    assert found[0].full_error <= 0.01
    assert all(r.kept for r in found)
    assert found[1].share < found[0].share
