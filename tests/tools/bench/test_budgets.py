"""When a trace had gained enough, and what a run within a budget has reached."""

import math
import time

import pytest
from bench.budgets import Scene, Spent, Stage, kept, time_of_gain, unlimited, within

from scan2albedo.core import TraceRow


def rows(*points, stage="fit"):
    return [(t, TraceRow(stage, t, t, k, error, "mm")) for k, (t, error) in enumerate(points)]


def test_the_last_measure_of_some_rows_decides():
    assert time_of_gain(rows((0.1, 10.0), (0.2, 5.0), (0.3, 1.1), (0.9, 1.0))) == 0.3
    trace = [*rows((0.1, 9), (0.2, 1), (0.3, 1), stage="icp"), *rows((0.5, 4), (0.6, 3), stage="tight_icp")]
    assert time_of_gain(trace) == 0.2
    assert time_of_gain(rows((1, 1e-2), (2, 1e-3), (3, 1e-6), (4, 1e-7))) == 4
    assert time_of_gain([*trace, *rows((0.7, 2.0), stage="tight_icp")]) == 0.7


def test_no_rows_no_time():
    assert time_of_gain([]) == math.inf
    assert time_of_gain(rows((0.1, math.nan))) == math.inf


@pytest.mark.parametrize(
    ("start", "found", "wall_s", "cpu_s", "reached", "over_s"),
    [
        (10.5, 1.0, 3.0, 1.5, 95, 1.0),
        (10.5, 1.0, 0.5, 0.5, 95, 0.0),
        (0.5, 0.5, 1.0, 1.0, 100, 0.0),
        (0.5, 1.0, 1.0, 1.0, 0, 0.0),
    ],
)
def test_reached_and_overrun(start, found, wall_s, cpu_s, reached, over_s):
    row = kept(Scene(Stage(None, float, start), 0.5, 1.0), Spent(found, 1.0, wall_s, cpu_s))
    assert row["reached %"] == pytest.approx(reached)
    assert row["over s"] == pytest.approx(over_s)


def obedient(budget, on_progress):
    """Halve an error of 8 every 10 ms until it is 0.01 or the budget ends."""
    begin = time.perf_counter()
    error = 8.0
    while error > 0.01 and (budget is None or time.perf_counter() - begin < budget):
        time.sleep(0.01)
        error /= 2
        if on_progress is not None:
            now = time.perf_counter() - begin
            on_progress(TraceRow("made up", now, now, 1, error, "mm"))
    return error


def test_a_stage_is_run_to_its_knee_and_within_a_tiny_budget():
    scene = unlimited(lambda: Stage(obedient, float, 8.0))
    assert scene.full_error <= 0.01
    assert scene.knee_s < 0.2
    knee, tiny = (kept(scene, within(scene, budget)) for budget in (None, 0.02))
    assert knee["reached %"] > 90 > tiny["reached %"]
