"""The tool and the runs of all stages on tiny scenes."""

import json

import pytest
from benchmarks.presets import preset_settings
from benchmarks.run import STAGES, benchmark_of, run_benchmarks
from error_vs_time import main


def test_every_stage_has_its_default_first():
    for name in set(STAGES):
        settings = benchmark_of(name).settings(False)
        assert settings[0].knob == "default", name
        names = [s.name for s in settings]
        assert len(set(names)) == len(names), name


@pytest.mark.parametrize("stage", sorted(set(STAGES) - {"glasses"}))
def test_presets_are_settings_of_their_stages(stage):
    presets = preset_settings(stage)
    default = benchmark_of(stage).settings(False)[0]
    # The best registration, fit and albedo are the default ones; the paper has a registration and an albedo.
    named = {"register": ["draft", "paper"], "albedo": ["draft", "paper"], "fit": ["draft"]}
    assert [s.value for s in presets] == named.get(stage, ["draft", "best"])
    assert all(type(s.options) is type(default.options) for s in presets)
    assert all(s.options != default.options for s in presets)


def test_an_unknown_stage_is_named(capsys):
    with pytest.raises(ValueError, match="'hair' is none of register"):
        run_benchmarks(["hair"])
    with pytest.raises(SystemExit) as ended:
        main(["hair"])
    assert ended.value.code == 2
    assert "'hair'" in capsys.readouterr().err


@pytest.mark.slow
def test_the_tool_sweeps_one_stage(tmp_path, capsys):
    main(["albedo", "-o", str(tmp_path / "out"), "--quick", "--no-budgets", "--no-slow", "--json"])
    numbers = json.loads(capsys.readouterr().out)
    (stage,) = numbers["stages"]
    errors = {p["name"]: p["errors"][0] for p in stage["points"]}
    assert max(errors["default"], errors["robust SH-2"]) < errors["homomorphic"]
    assert (tmp_path / "out" / "error_vs_time.png").exists()


@pytest.mark.slow
def test_all_stages_run_on_tiny_scenes():
    report = run_benchmarks(quick=True)
    assert [stage.stage for stage in report.stages] == list(STAGES)
    for stage in report.stages:
        assert stage.front(0), stage.stage
        best = min(p.errors[0] for p in stage.ours)
        assert best < 10, stage.stage
    assert len(report.budgets) == 9
    assert all(row.share > 0.5 for row in report.budgets if row.knee)
