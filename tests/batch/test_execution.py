"""Workers that die take at most one scan with them, and only after a second chance."""

import sys

import pytest
from helpers.batches import statuses

from scan2albedo.batch import execution
from scan2albedo.errors import BatchError, MissingDependencyError


@pytest.mark.slow
def test_a_worker_that_dies_costs_at_most_its_own_scan(batched, quick_stages, out):
    names = ("a", "kills", "kills-always", "waits", "b", "raises", "nofile")
    report = batched(*names, jobs=2)
    failed = dict.fromkeys(("kills-always", "raises", "nofile"), "failed")
    assert statuses(out) == dict.fromkeys(("a", "kills", "waits", "b"), "done") | failed
    assert "died twice (SIGKILL(-9))" in report.failures["kills-always"]
    assert report.failures["raises"] == "ZeroDivisionError: of a kind nobody thought of"
    assert "cannot be read" in report.failures["nofile"]
    assert (quick_stages("kills"), quick_stages("kills-always")) == (2, 2)


@pytest.mark.slow
def test_a_scan_that_takes_too_long_is_given_up(batched, quick_stages):
    report = batched("sleeps", "a", "b", jobs=2, timeout_s=1.5)
    assert report.failures == {"sleeps": "took longer than 1.5 s (--timeout)"}
    assert quick_stages("sleeps") == 1


@pytest.mark.slow
def test_processes_that_die_before_any_scan_end_the_batch(batched, monkeypatch, out):
    def die(task):
        import os

        os._exit(3)

    monkeypatch.setattr("scan2albedo.batch.execution.worker.process_task", die)
    with pytest.raises(BatchError, match=r"die before they begin a scan \(EXIT\(3\)\)"):
        batched("a", jobs=1)
    assert statuses(out) == {"a": "not run"}


def test_what_no_posix_system_has_is_one_clear_error(batched, monkeypatch, out):
    monkeypatch.setattr("scan2albedo.batch.run._POSIX", False)
    with pytest.raises(BatchError, match=r"need Linux or macOS; .* `scan2albedo process`"):
        batched("a")
    assert not out.exists()


@pytest.mark.parametrize("library", ["loky", "psutil", "pyarrow"])
def test_a_missing_library_is_named_with_its_extra_before_any_work(batched, library, monkeypatch, out):
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(MissingDependencyError, match=rf"{library}.*pip install 'scan2albedo\[batch\]'"):
        batched("a")
    assert not out.exists()


def test_a_task_that_raises_outside_of_the_stages_fails_alone(batched, monkeypatch):
    def process_task(task):
        if task.name == "bad":
            raise RecursionError("too\ndeep")
        return task.record("done")

    monkeypatch.setattr(execution.worker, "process_task", process_task)
    report = batched("a", "bad", "b", jobs=1)
    assert report.failures == {"bad": "RecursionError: too"}
    assert report.progress.done == 2


def test_what_a_worker_finished_just_before_an_interrupt_is_done(batched, monkeypatch, out):
    def interrupted(tasks, layout, jobs):
        layout.keep(tasks[0].record("done"))
        raise KeyboardInterrupt
        yield

    monkeypatch.setattr("scan2albedo.batch.run.run_in_processes", interrupted)
    with pytest.raises(KeyboardInterrupt):
        batched("a", "b", jobs=1)
    assert statuses(out) == {"a": "done", "b": "not run"}
