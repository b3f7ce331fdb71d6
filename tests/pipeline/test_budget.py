"""A budget is held whatever is asked for: what does not fit is left out, and the plan says so."""

import time
from dataclasses import replace
from itertools import product
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from helpers.faces import with_template

import scan2albedo as s2a
from scan2albedo.core import Budget
from scan2albedo.pipeline import clock as clocks, unlit as outputs
from scan2albedo.pipeline.clock import Clock
from scan2albedo.pipeline.options import ProcessOptions
from scan2albedo.pipeline.result import Run as Scan
from scan2albedo.pipeline.stages import FindAlbedo, Fit, Register

ASKED = tuple(
    product(
        (None, "face", "all"),
        (0, 1, 10),
        (None, "chart", "scan", "template"),
        (0, 2048, 8192),
        (1024, 8192),
        ((), ("eyes",)),
    )
)
"""Reaches of the unlit scan, tiles, maps, sides of the scan's texture (0 are colours of vertices), sides of
made textures, what is skipped."""
FIELDS = {"unlit": "unlit", "template_texture": "template", "maps": "maps_of_skin"}


def squares(count):
    """Texture coordinates of a triangle in each of so many tiles."""
    return np.array([[0.1, 0.1], [0.9, 0.1], [0.1, 0.9]]) + np.arange(count)[:, None, None] * [1, 0]


class Run:
    """A run whose stages take the seconds that are expected of them, on a clock that nothing else moves."""

    def __init__(self, monkeypatch, pace=1.0):
        self.pace = pace
        monkeypatch.setattr(clocks, "time", SimpleNamespace(perf_counter=lambda: self.now))
        baked = SimpleNamespace(parts=())
        eyes = SimpleNamespace(reason="made up")
        for name, stage in {
            "LightRemoval": lambda *stages: SimpleNamespace(unlit=self.unlit),
            "template_texture": lambda *given: self.takes(self.costs["template_texture"].make_s, baked),
            "engine_maps": lambda *given: self.takes(self.costs["maps"].make_s, baked),
            "ProcessedFace": SimpleNamespace(of_stages=lambda *given: None),
            "median_light": lambda *given: 1.0,
            "eyes_and_mouth": lambda *given: self.takes(outputs.EYES_S, eyes),
            "on_template": lambda inside, fitted, gain, made: made,
        }.items():
            monkeypatch.setattr(outputs, name, stage)

    def takes(self, seconds, made=None):
        self.now += self.pace * seconds
        return made

    def unlit(self, reach):
        self.lit.append(reach)
        made = SimpleNamespace(scan=None, hair=None, confidence=np.ones(1))
        return self.takes(outputs.light_s(self.scan), made)

    def __call__(self, budget, unlit, tiles, maps, side, texture_size, skip):
        """Return what is made by its name, and the plan; `now` is then the time with all files written."""
        self.now = 0.0
        self.lit = []
        texture = SimpleNamespace(shape=(side, side, 3)) if side else None
        uv = squares(1) if side else None
        self.scan = SimpleNamespace(texture_linear=texture, uv=uv, vertices=range(100_000), name="made up")
        model = SimpleNamespace(template_uv=squares(tiles) if tiles else None)
        options = ProcessOptions(unlit=unlit, maps=maps, texture_size=texture_size, skip=skip)
        wanted = outputs.wanted_outputs(self.scan, model, options)
        self.costs = {output.name: output for output in wanted}
        run = Scan(None, replace(options, budget=budget))
        run.scan, run.model = self.scan, model
        clock = Clock(Budget(budget))
        clock.due_s["unlit"] = outputs.Unlit().cost_s(run)
        for search in (Register, Fit, FindAlbedo):
            with clock.timed(search.name):
                self.now += min(clock.share(search.share).seconds or 5.0, 5.0)
        self.face_s = self.now
        run.fitted, run.albedo = SimpleNamespace(model=model), SimpleNamespace(image=None)
        steps = outputs.Unlit().run(run, clock)
        made = {name for name, field in FIELDS.items() if getattr(run, field) is not None}
        for name in made:
            self.takes(self.costs[name].files_s)
        return made, steps


@pytest.mark.parametrize("pace", [0.7, 1.0, 1.05])
def test_no_combination_of_outputs_overruns_a_budget(monkeypatch, pace):
    run = Run(monkeypatch, pace)
    for budget, asked in product((0.01, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0), ASKED):
        made, steps = run(budget, *asked)
        assert run.now <= max(budget + max(2.0, budget / 10), run.face_s), asked
        assert len(run.lit) == len(set(run.lit)), "the light is taken off twice"
        told = {step.stage: step for step in steps}
        for name in run.costs:
            assert told[name].ran == (name in made), asked
            assert told[name].ran or "left out: the budget ended before it" in told[name].reason


@pytest.mark.parametrize("budget", [None, 1e6])
def test_with_enough_time_all_is_made(monkeypatch, budget):
    run = Run(monkeypatch)
    for asked in ASKED:
        made, steps = run(budget, *asked)
        assert len(made) == len(run.costs)
        assert not [step for step in steps if step.level == "wrong"]


def test_a_greater_budget_makes_more_and_files_count(monkeypatch):
    run, names = Run(monkeypatch), []
    for budget in range(10, 300, 2):
        made, steps = run(float(budget), "all", 0, "chart", 8192, 1024, ())
        late = [step for step in steps if step.level == "wrong"]
        if set(made) == {"unlit"}:
            assert late[0].reason == "maps are left out: the budget ended before it"
            assert "s left, " in late[0].evidence
        names.append(len(made))
    assert names == sorted(names)
    assert set(names) == {0, 1, 2}


@pytest.mark.slow
@pytest.mark.parametrize("budget", [12.0, 40.0])
def test_a_real_run_with_a_large_texture_holds_it(coarse_scan, tmp_path, budget):
    """In seconds of this process where it has no core of its own."""
    scan = coarse_scan[0]
    large = cv2.resize(scan.texture_linear, (4096, 4096), interpolation=cv2.INTER_LINEAR)
    asked = {"model": with_template(), "unlit": "face", "maps": "scan"}
    asked |= {"size": 64, "quality": "draft", "texture_size": 1024, "pictures": False}
    s2a.process(scan, **asked | {"texture_size": 8})  # kernels are compiled
    begin = time.perf_counter(), time.process_time()
    result = s2a.process(replace(scan, texture_linear=large), tmp_path, budget=budget, **asked)
    took = min(time.perf_counter() - begin[0], time.process_time() - begin[1])
    assert took < budget + max(2.0, budget / 10)
    assert any("left out: the budget ended before it" in step.reason for step in result.plan)
