"""Sweeps over a stage made up for the test."""

import time
from dataclasses import replace

import numpy as np
import pytest
from benchmarks.report import StageReport
from benchmarks.sweep import Cost, ErrorKind, Outcome, Peer, Setting, StageBenchmark, measured, timed, varied

from scan2albedo.errors import EyeglassesError
from scan2albedo.fitting import FitOptions


def made_up(calls=None):
    """Scenes are numbers; a setting of effort e errs by the scene over e and costs e seconds."""

    def run(scene, setting):
        if calls is not None:
            calls.append((scene, setting.name))
        return Outcome(
            Cost(setting.options, 2 * setting.options), (scene / setting.options,), 7, {"x": scene}
        )

    return StageBenchmark(
        "made up",
        (ErrorKind("error", "mm"),),
        lambda quick: [1.0] if quick else [1.0, 3.0],
        lambda quick: [Setting("default", "", 2.0), Setting("effort", "4", 4.0)],
        run,
        lambda quick: [
            Peer("slow", lambda scene: Outcome(Cost(10.0, 10.0), (scene,))),
            Peer("absent", lambda scene: pytest.fail("it is not there"), "pip install absent"),
        ],
    )


def test_points_are_means_over_scenes():
    default, effort, slow = measured(made_up())
    assert default.errors == (1.0,)
    assert default.worst == (1.5,)
    assert (effort.cpu_s, effort.wall_s, effort.evaluations, effort.details["x"]) == (4.0, 8.0, 7.0, 2.0)
    assert (slow.name, slow.is_ours, slow.errors) == ("slow", False, (2.0,))


def test_everything_runs_once_before_the_clock_counts():
    calls = []
    measured(made_up(calls), quick=True)
    assert calls.count((1.0, "effort 4")) == 2


def test_of_repeats_the_cheapest_counts():
    costs = iter([5.0, 3.0, 9.0, 4.0])
    stage = made_up()
    setting = Setting("default", "", 1.0)

    def run(scene, _):
        return Outcome(Cost(next(costs), 1.0), (1.0,))

    one = StageBenchmark(
        "one", stage.errors, lambda quick: [0], lambda quick: [setting], run, lambda quick: []
    )
    assert measured(one, repeats=3)[0].cpu_s == 3.0


def test_varied_changes_one_field():
    settings = varied("steps", FitOptions(), (3, 5))
    assert [s.options.steps for s in settings] == [3, 5]
    assert settings[0].options.levels == FitOptions().levels


def test_timed_counts_work_but_not_sleep_as_cpu():
    result, cost = timed(lambda: time.sleep(0.05) or "done")
    assert result == "done"
    assert cost.wall_s >= 0.05
    assert cost.cpu_s < cost.wall_s


def test_a_peer_that_fails_is_left_out_and_said():
    def fail(scene):
        raise RuntimeError("no licence")

    stage = replace(made_up(), peers=lambda quick: [Peer("broken", fail)])
    with pytest.warns(RuntimeWarning, match="broken failed and is left out: no licence"):
        points = measured(stage)
    assert np.isnan(points[-1].errors[0])
    report = StageReport("made up", stage.errors, tuple(points))
    assert "broken" in report.table()
    assert report.table().splitlines()[-1].endswith("failed")


def test_a_setting_that_is_refused_does_not_end_the_sweep():
    def run(scene, setting):
        if setting.knob == "effort":
            raise EyeglassesError("too coarse")
        return Outcome(Cost(1.0, 1.0), (scene,))

    stage = replace(made_up(), run=run)
    with pytest.warns(RuntimeWarning, match="effort 4 failed and is left out: too coarse"):
        points = measured(stage)
    report = StageReport("made up", stage.errors, tuple(points))
    assert [p.name for p in report.front()] == ["default"]
    assert report.table().splitlines()[-1].endswith("failed")
