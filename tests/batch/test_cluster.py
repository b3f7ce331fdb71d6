"""The same batch on a dask cluster."""

import sys
from concurrent.futures import CancelledError
from contextlib import nullcontext
from types import SimpleNamespace

import pytest
from helpers.batches import statuses

from scan2albedo.errors import BatchError, MissingDependencyError


@pytest.fixture(scope="module")
def cluster():
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2,
        processes=True,
        threads_per_worker=1,
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
        silence_logs="CRITICAL",
    ) as cluster:
        yield cluster


@pytest.mark.slow
def test_scans_that_kill_their_workers_are_tried_again_and_fail_alone(batched, quick_stages, cluster):
    options = {"scheduler": cluster.scheduler_address, "resume": True}
    report = batched("a", "kills-always", "b", "c", **options)
    assert report.failures.keys() == {"kills-always"}
    assert "KilledWorker" in report.failures["kills-always"]
    assert (quick_stages("kills-always"), report.jobs, report.progress.done) == (4, 2, 3)
    report = batched("d", "kills", "e", "raises", "nofile", "f", **options)
    assert report.failures.keys() == {"raises", "nofile"}
    assert (quick_stages("kills"), report.progress.done) == (2, 4)


@pytest.mark.slow
def test_no_scheduler_is_one_clear_error(batched):
    dask = pytest.importorskip("dask")
    quick = dask.config.set({"distributed.comm.timeouts.connect": "1s"})
    with quick, pytest.raises(BatchError, match=r"no dask scheduler answers at tcp://127.0.0.1:9"):
        batched("a", scheduler="tcp://127.0.0.1:9")


def test_without_dask_the_command_that_installs_it_is_told(batched, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'scan2albedo\[cluster\]'"):
        batched("a", scheduler="tcp://127.0.0.1:9")


class Answers(nullcontext):
    """Stands for a dask client with one worker: each task ends at once, processed or as its name says."""

    def __init__(self, endings):
        super().__init__(self)
        self.endings = endings

    def nthreads(self):
        return {"worker": 1}

    def submit(self, function, task, **_):
        return Answer(function, task, *self.endings.get(task.name, ("finished", None)))


class Answer:
    """Stands for a dask future."""

    def __init__(self, function, task, status, error):
        self.function, self.task, self.status, self.error = function, task, status, error

    def add_done_callback(self, done):
        done(self)

    def result(self):
        if self.error is not None:
            raise self.error
        return self.function(self.task)


@pytest.fixture
def answering(monkeypatch, batched, no_workers):
    """Run a batch of the scans a, b and c on a cluster whose tasks end as told."""

    def run(**endings):
        stand_in = SimpleNamespace(Client=lambda address, **_: Answers(endings))
        monkeypatch.setitem(sys.modules, "distributed", stand_in)
        return batched("a", "b", "c", scheduler="tcp://127.0.0.1:9")

    return run


def test_a_task_that_raises_in_its_worker_fails_alone(answering):
    report = answering(b=("error", ModuleNotFoundError("No module named 'scan2albedo'")))
    assert report.failures == {"b": "ModuleNotFoundError: No module named 'scan2albedo'"}
    assert report.progress.done == 2


def test_a_scheduler_that_is_lost_ends_the_batch(answering, out):
    with pytest.raises(BatchError, match=r"tcp://127\.0\.0\.1:9 is gone; --resume"):
        answering(b=("cancelled", CancelledError("b")))
    assert statuses(out) == {"a": "done", "b": "not run", "c": "not run"}
