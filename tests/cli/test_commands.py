"""The command line: exit statuses, one clear line an error, JSON on stdout."""

import json
import os
import signal
import subprocess
import sys
import time
import tomllib
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from helpers.cli import invoke
from helpers.commands import printed, refusal, succeeded
from helpers.meshes import write_ball
from helpers.square import write_square_obj
from helpers.usage import COMMAND, run_process, usage_error

from scan2albedo.cli import commands as cli, doctor
from scan2albedo.cli.common import echo_json
from scan2albedo.core import Plan, PlanStep, RawScan
from scan2albedo.core.version import VERSION
from scan2albedo.pipeline import sequence, validation
from scan2albedo.pipeline.sequence import SequenceResult
from scan2albedo.sampling import geometry_image_of_scan

both_signals = pytest.mark.parametrize(
    ("number", "status", "word"), [(signal.SIGINT, 130, "interrupted"), (signal.SIGTERM, 143, "terminated")]
)


def test_the_version_is_printed():
    assert succeeded(invoke("--version")).stdout == f"scan2albedo {VERSION}\n"


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    """A coloured sphere: an object, no face."""
    return write_ball(tmp_path_factory.mktemp("scans") / "ball.ply", 3)


@pytest.fixture(autouse=True)
def own_signals(monkeypatch):
    """Signals stay those of pytest."""
    monkeypatch.setattr(cli.common, "stop_cleanly_on_interrupt", lambda out: None)


def test_an_object_is_processed_and_summarised_as_json(ball, tmp_path):
    done = run_process("process", ball, "-o", tmp_path, "--model", "none", "--size", 64, "--json")
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary["status"] == "done"
    assert (tmp_path / "ball" / "result.json").is_file()
    assert "ball: done" in done.stderr
    assert "ball: unit: mm" in done.stderr
    assert any(note.startswith("unit: mm") for note in summary["notes"])


def test_some_failed_is_1(ball, tmp_path):
    quick = ("--model", "none", "--size", 32, "--json")
    some = invoke("process", ball, tmp_path / "none.obj", "-o", tmp_path, *quick)
    assert some.exit_code == 1
    assert [entry["status"] for entry in json.loads(some.stdout)] == ["done", "failed"]


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("empty.obj", b"", "empty"),
        ("cloud.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "point cloud"),
        ("nan.obj", b"v 0 0 nan\nv 100 0 0\nv 0 100 0\nf 1 2 3\n", "NaN"),
        ("index.obj", b"v 0 0 0\nv 100 0 0\nv 0 100 0\nf 1 2 9\n", "damaged or truncated"),
        ("three.obj", b"v 0 0 0\nv 100 0 0\nv 0 100 0\nf 1 2 3\n", "3 vertices"),
        ("garbage.ply", bytes(range(256)) * 4, "garbage.ply"),
        ("notes.txt", b"hello", "not supported"),
    ],
)
def test_a_bad_file_ends_in_one_line_and_exit_2(tmp_path, name, content, words):
    (tmp_path / name).write_bytes(content)
    failed = invoke("process", tmp_path / name, "-o", tmp_path / "out")
    assert isinstance(failed.exception, SystemExit)
    line = refusal(failed)
    assert words in line
    assert name.split(".")[0] in line
    assert not (tmp_path / "out").exists()


def test_every_table_of_the_paper_is_printed_and_summarised_as_json(monkeypatch):
    row = validation.ValidationRow(30.0, "wood", "lambert", 5.0, 0.02, 0.03, 0.01, 0.5, 1)
    monkeypatch.setattr(validation, "validation_row", lambda scene, angle, brdf: row)
    monkeypatch.setattr(
        validation, "lighting_row", lambda seed, size: validation.LightingRow(seed, 12.0, 2.0)
    )
    done = invoke("validate", "--size", 16, "--json")
    tables = printed(done)
    assert [len(tables[name]["rows"]) for name in ("hemisphere", "face", "lighting")] == [12, 12, 2]
    assert tables["hemisphere"]["worst_mse_percent"] == 0.03
    assert tables["lighting"]["albedo_std_percent"] == 2.0
    assert done.stderr.count("wood") == 24
    assert "the paper" in invoke("validate", "lighting", "--size", 16).stdout


@pytest.mark.parametrize(
    "arguments",
    [
        "process x.obj",
        "process x.obj -o out --lights many",
        "process x.obj -o out --skip nonsense",
        "process x.obj -o out --force fit",
        "process x.obj -o out --lights 0",
        "process x.obj -o out --brdf phong",
        "process x.obj -o out --unit yard",
        "process x.obj -o out --budget 0",
        "process x.obj -o out --size 7",
        "validate everything",
        "frobnicate",
    ],
)
def test_usage_errors_are_2(arguments, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    failed = invoke(*arguments.split())
    assert isinstance(failed.exception, SystemExit)
    assert usage_error(failed).count("Error") == 1
    assert failed.stdout == ""
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("a/face.obj", "b/face.ply"), "would both be written"),
        (("a.obj", "b.obj", "--landmarks", "marks.csv"), "folder with files"),
    ],
)
def test_scans_of_one_name_or_one_file_of_landmarks_are_refused(tmp_path, arguments, words):
    assert words in usage_error(invoke("process", *arguments, "-o", tmp_path))
    assert list(tmp_path.iterdir()) == []


def test_what_is_infinite_is_null_in_the_summary(capsys):
    echo_json({"light_distance_mm": float("inf"), "mean_mm": np.float64("nan"), "lights": np.int64(2)})
    assert json.loads(capsys.readouterr().out) == {"light_distance_mm": None, "mean_mm": None, "lights": 2}


@both_signals
def test_interrupting_leaves_nothing_behind(ball, tmp_path, number, status, word):
    command = [*COMMAND, "process", ball, "-o", tmp_path, "--model", "none", "--size", "2048"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    assert "reading" in process.stderr.readline()
    time.sleep(0.5)
    process.send_signal(number)
    _, complaint = process.communicate(timeout=120)
    assert process.returncode == status
    assert word in complaint
    assert "Traceback" not in complaint
    assert os.listdir(tmp_path) == []


@both_signals
@pytest.mark.parametrize("broken", [False, True])
def test_a_signal_while_a_line_is_written_ends_the_process(number, status, word, broken):
    # Python handles a signal before the write that it came in has returned.
    code = (
        "import io, signal, sys\n"
        "from scan2albedo.cli.common import stop_cleanly_on_interrupt\n"
        "class Stderr(io.FileIO):\n"
        "    def write(self, data):\n"
        f"        signal.raise_signal({int(number)})\n"
        "        return super().write(data)\n"
        "sys.stderr = io.TextIOWrapper(io.BufferedWriter(Stderr(2, 'w')))\n"
        "stop_cleanly_on_interrupt(None)\n"
        "print('a line', file=sys.stderr, flush=True)\n"
    )
    reading, writing = os.pipe()
    if broken:
        os.close(reading)
    done = subprocess.run([sys.executable, "-c", code], stderr=writing, timeout=60, check=False)
    os.close(writing)
    assert done.returncode == status
    if not broken:
        with os.fdopen(reading) as said:
            assert said.read() == f"scan2albedo: {word}; nothing half-written was left behind\n"


@pytest.mark.slow
def test_doctor_finds_a_healthy_machine():
    examined = run_process("doctor", "--json")
    assert examined.returncode == 0, examined.stdout
    findings = json.loads(examined.stdout)
    assert {"open3d", "numpy", "default face model"} <= {finding["subject"] for finding in findings}


def test_doctor_finds_every_library_of_pyproject_by_the_name_that_imports_it():
    project = tomllib.loads((Path(__file__).resolve().parents[2] / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    of_extras = [f"{line}; extra == '{extra}'" for extra, lines in extras.items() for line in lines]
    found = doctor.libraries([*project["dependencies"], *of_extras])
    assert found["open3d"][0].startswith("open3d-cpu>=")
    assert {extra for _, extra in found.values()} == {"", *extras} - set(doctor.DEVELOPERS)
    for package, (_, extra) in found.items():
        module = doctor.IMPORT_NAMES.get(package, package)
        assert extra or find_spec(module) is not None, package
    assert set(doctor.IMPORT_NAMES) <= set(found)


def test_doctor_tells_the_command_for_a_missing_library():
    for extra, installed in (("", "no-such-package>=1"), ("report", "scan2albedo[report]")):
        finding = doctor.examined_library("no-such-package", "no-such-package>=1", extra)
        assert finding.good == bool(extra)
        assert f"pip install '{installed}'" in finding.remedy
    assert "[report] alone" in finding.detail


def test_doctor_names_the_system_packages_when_open3d_cannot_load(monkeypatch):
    def broken(*arguments, **options):
        return subprocess.CompletedProcess(
            arguments, 1, "", "ImportError: libGL.so.1: cannot open shared object file"
        )

    monkeypatch.setattr(doctor.subprocess, "run", broken)
    finding = doctor.examined_library("open3d", "open3d>=0.19")
    assert "libgl1" in finding.remedy
    assert "libGL.so.1" in finding.detail


@pytest.mark.parametrize("error", [MemoryError, RecursionError, OverflowError])
def test_a_scan_that_is_too_large_does_not_stop_the_next_and_all_failed_is_2(tmp_path, monkeypatch, error):
    taken = []

    def too_large(scan, *_, **__):
        taken.append(scan.name)
        raise error

    monkeypatch.setattr("scan2albedo.pipeline.stages.register", too_large)
    files = [write_square_obj(tmp_path, name=name, texture=f"{name}.png") for name in ("first", "second")]
    told = usage_error(invoke("process", *files, "-o", tmp_path / "out"))
    assert taken == ["first", "second"]
    for name in taken:
        assert f"error: {name}: " in told


def test_strict_is_1_where_a_texture_is_missing(tmp_path):
    path = write_square_obj(tmp_path)
    asked = ("process", path, "-o", tmp_path / "out", "--model", "none", "--unit", "cm")
    asked += ("--size", "16", "--no-pictures")
    succeeded(invoke(*asked, "--strict"))
    (tmp_path / "face.png").unlink()
    succeeded(invoke(*asked))
    told = invoke(*asked, "--strict")
    assert told.exit_code == 1
    assert "no albedo: texture face.png is missing beside the scan (--textures names" in told.stderr
    assert (tmp_path / "out" / "face" / "result.json").exists()


@pytest.mark.parametrize("error", [MemoryError(), ValueError("no such light"), RecursionError("too deep")])
def test_no_error_leaves_the_commands_bare(monkeypatch, capsys, error):
    def fail():
        raise error

    monkeypatch.setattr(cli, "app", fail)
    with pytest.raises(SystemExit, match="2"):
        cli.main()
    shown = capsys.readouterr().err
    assert shown.startswith(f"scan2albedo: error: {str(error) or type(error).__name__}")
    assert shown.count("\n") == 1


def test_frames_of_a_take_are_followed_and_a_broken_one_fails_by_name(monkeypatch, tmp_path):
    """The command says what the result does, and leaves options to the library."""
    called = []

    def follow(frames, out, *, name, fps, on_progress, **options):
        called.append((frames, name, fps, options["quality"]))
        figures = {"used": True, "found_again": False, "cpu_s": 0.5, "residual_mm": 0.25, "notes": ()}
        rows = [{**figures, "file": str(frame)} for frame in frames]
        rows[1] |= {"used": False, "notes": ("left out: it is empty",)}
        plan = Plan((PlanStep.doubt("sequence.frame", "frame 2, b/scan.obj: left out: it is empty"),))
        scan = RawScan(np.eye(3), [[0, 1, 2]], name=name)
        whole = {"scan": scan, "geometry_image": geometry_image_of_scan(scan, 8), "plan": plan, "seed": 0}
        absent = dict.fromkeys(("registration", "fitted", "albedo", "trace", "control_points", "poses"))
        return SequenceResult(**whole, **absent, frames=tuple(rows), fps=fps, timings_s={}, options={})

    monkeypatch.setattr(sequence, "process_sequence", follow)
    frames = [Path(folder) / "scan.obj" for folder in "abc"]  # of one name: they get no folders
    given = ("person", "smile", *frames, "-o", tmp_path)
    done = invoke(*given, "--sequence", "--fps", 25, "--quality", "draft", "--json")
    assert done.exit_code == 1, done.output
    assert called == [(frames, "smile", 25.0, "draft")]
    assert "followed through 2 of 3 frames; fit 0.25 mm mean" in done.stderr
    assert "frame 2, b/scan.obj: left out: it is empty" in done.stderr
    assert [frame["used"] for frame in json.loads(done.stdout)["frames"]] == [True, False, True]
    usage_error(invoke(*given))


def test_a_person_of_no_usable_scan_is_one_line(tmp_path):
    done = run_process("person", "ann", tmp_path / "missing.obj", "-o", tmp_path / "out")
    assert done.returncode == 2
    *_, line = done.stderr.splitlines()
    assert "ann: no scan can be used:" in line
    assert "missing.obj" in line
    assert not (tmp_path / "out").exists()
