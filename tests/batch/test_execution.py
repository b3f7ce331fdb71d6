"""Workers that die take at most one scan with them, and only after a second chance."""

import pytest

from scan2albedo.batch import load_catalogue, run_batch
from scan2albedo.errors import BatchError
from scan2albedo.process_options import ProcessOptions

TINY = ProcessOptions(model="none", size=32, pictures=False)


def statuses(out):
    return {row["name"]: row["status"] for row in load_catalogue(out).to_pylist()}


def test_a_worker_that_kills_itself_once_costs_nothing(scans_in, tmp_path, quick_stages):
    report = run_batch(scans_in("a", "kills", "waits", "b"), tmp_path / "out", options=TINY, jobs=2)
    assert statuses(tmp_path / "out") == dict.fromkeys(("a", "kills", "waits", "b"), "done")
    assert quick_stages("kills") == 2
    assert report.progress.failed == 0


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_worker_that_always_dies_fails_its_scan_alone(scans_in, tmp_path, quick_stages, jobs):
    names = ("a", "kills-always", "b", "raises", "nofile")
    report = run_batch(scans_in(*names), tmp_path / "out", options=TINY, jobs=jobs)
    assert statuses(tmp_path / "out") == dict.fromkeys(names, "failed") | {"a": "done", "b": "done"}
    assert "died twice (SIGKILL(-9))" in report.failures["kills-always"]
    assert report.failures["raises"] == "ZeroDivisionError: of a kind nobody thought of"
    assert "cannot be read" in report.failures["nofile"]
    assert quick_stages("kills-always") == 2


def test_a_scan_that_takes_too_long_is_given_up(scans_in, tmp_path, quick_stages):
    manifest = scans_in("sleeps", "a", "b")
    report = run_batch(manifest, tmp_path / "out", options=TINY, jobs=2, timeout_s=1.5)
    assert report.failures == {"sleeps": "took longer than 1.5 s (--timeout)"}
    assert quick_stages("sleeps") == 1


def test_processes_that_die_before_any_scan_end_the_batch(scans_in, tmp_path, monkeypatch):
    def die(task):
        import os

        os._exit(3)

    monkeypatch.setattr("scan2albedo.batch.execution.worker.process_task", die)
    with pytest.raises(BatchError, match=r"die before they begin a scan \(EXIT\(3\)\)"):
        run_batch(scans_in("a"), tmp_path / "out", options=TINY, jobs=1)
    assert statuses(tmp_path / "out") == {"a": "not run"}
