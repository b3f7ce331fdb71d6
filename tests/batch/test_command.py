"""`scan2albedo batch` as a user runs it."""

import json
import os
import signal
import subprocess
import time

import pytest
from helpers.batches import stamps, statuses
from helpers.cli import invoke as invoked
from helpers.commands import printed, succeeded
from helpers.records import read_json
from helpers.usage import COMMAND, run_process, usage_error

from scan2albedo.cli.commands import app

TINY = ("--model", "none", "--size", "32", "--unit", "mm", "--no-pictures", "--quality", "draft")


def invoke(*arguments):
    return invoked("batch", *arguments)


def test_exit_statuses_and_the_summary(scans_in, tmp_path, no_workers):
    some = invoke(scans_in("a", "nofile"), "-o", tmp_path / "some", *TINY, "--json")
    assert some.exit_code == 1
    assert json.loads(some.stdout)["failures"][0]["name"] == "nofile"
    assert "batch: 1 of 2 done, 1 failed" in some.stderr
    assert "failed: nofile:" in some.stderr
    usage_error(invoke(scans_in("nofile"), "-o", tmp_path / "none", *TINY))
    asked = (scans_in("a"), "-o", tmp_path / "all", *TINY)
    succeeded(invoke(*asked))
    again = invoke(*asked, "--resume", "--json")
    assert printed(again)["kept"] == 1
    assert "batch: kept 1 (hashes verified), 0 to do" in again.stderr


def test_scans_without_their_textures_are_told_and_strict_is_1(scans_in, tmp_path, no_workers, out):
    asked = (scans_in("a", "bare"), "-o", out, *TINY)
    done = succeeded(invoke(*asked))
    assert "  bare: texture skin.jpg is missing: went on without it" in done.stderr.splitlines()
    assert invoke(*asked, "--resume", "--strict").exit_code == 1
    succeeded(invoke(scans_in("a"), "-o", tmp_path / "whole", *TINY, "--strict"))


def test_a_fault_of_the_manifest_is_one_line_and_leaves_nothing(tmp_path):
    failed = run_process("batch", "none.csv", "-o", "out", cwd=tmp_path)
    assert failed.returncode == 2
    assert failed.stderr.startswith("scan2albedo: error: manifest none.csv cannot be read")
    assert len(failed.stderr.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("wrong", [("--timeout", "0"), ("--lights", "many"), ("--jobs", "-1")])
def test_wrong_flags_are_2(wrong, scans_in, out):
    usage_error(invoke(scans_in("a"), "-o", out, *wrong))
    assert not out.exists()


def test_it_has_the_flags_of_process():
    from typer.main import get_command

    commands = get_command(app).commands
    flags = {option for parameter in commands["process"].params for option in parameter.opts} - {"scans"}
    assert "--pictures" in flags
    assert flags <= {option for parameter in commands["batch"].params for option in parameter.opts}


def started(manifest, layout, rows):
    """Begin a batch and return its process when it has that many rows; its lines go into a file."""
    command = [*COMMAND, "batch", manifest, "-o", layout.out, *TINY, "--jobs", "2"]
    with (manifest.parent / "stderr").open("w") as said:
        process = subprocess.Popen(command, stderr=said, start_new_session=True)
    deadline = time.monotonic() + 200
    while len(list(layout.rows.glob("*.json"))) < rows and time.monotonic() < deadline:
        assert process.poll() is None, (manifest.parent / "stderr").read_text()
        time.sleep(0.05)
    return process


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_raises_only_while_scans_are_processed(tmp_path, monkeypatch, number, status):
    monkeypatch.setattr("scan2albedo.batch.run_batch", lambda *_, **__: signal.raise_signal(number))
    assert invoke(tmp_path, "-o", tmp_path).exit_code == status
    for each in (signal.SIGINT, signal.SIGTERM):
        assert signal.getsignal(each).__qualname__ == "stop_cleanly_on_interrupt.<locals>.stop"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("send", "number", "status", "word"),
    [
        (os.kill, signal.SIGINT, 130, "interrupted"),
        (os.kill, signal.SIGTERM, 143, "terminated"),
        (os.killpg, signal.SIGTERM, 143, "terminated"),  # to the workers as well
        (os.kill, signal.SIGKILL, -9, ""),
    ],
)
def test_a_batch_that_is_ended_leaves_no_workers_and_what_was_done_is_kept(
    scans_in, send, number, status, word, out, layout
):
    import psutil

    names = [f"ball{i}" for i in range(5)]
    manifest = scans_in(*names)
    process = started(manifest, layout, 2)
    children = psutil.Process(process.pid).children(recursive=True)
    send(process.pid, number)
    assert process.wait(timeout=60) == status
    _, alive = psutil.wait_procs(children, timeout=5)
    assert alive == []
    if word:
        said = (manifest.parent / "stderr").read_text()
        assert "Traceback" not in said
        assert len([line for line in said.splitlines() if word in line]) == 1
        assert not list(out.rglob("*.part*"))
        assert read_json(out / "batch.json")["status"] == "interrupted"
        assert set(statuses(out).values()) == {"done", "not run"}
    finished = [path.stem for path in layout.rows.glob("*.json")]
    assert 2 <= len(finished) < 5
    before = [stamps(out / name) for name in finished]
    done = invoke(manifest, "-o", out, *TINY, "--jobs", "1", "--resume", "--json")
    assert printed(done)["kept"] == len(finished)
    assert f"kept {len(finished)} (hashes verified), {5 - len(finished)} to do" in done.stderr
    assert [stamps(out / name) for name in finished] == before
    assert statuses(out) == dict.fromkeys(names, "done")
    assert not list(out.rglob("*.part*"))
