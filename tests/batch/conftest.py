"""Manifests of tiny coloured balls, and a stand-in for the stages that is done at once."""

import csv

import numpy as np
import pytest
import trimesh
from helpers.batches import TINY

from scan2albedo.batch import execution, run, run_batch, worker
from scan2albedo.batch.records import Layout


@pytest.fixture(scope="session")
def ball_text():
    """PLY of a coloured ball of 162 vertices, 180 mm wide."""
    mesh = trimesh.creation.icosphere(2, 90.0)
    mesh.visual.vertex_colors = np.clip(128 + mesh.vertices, 0, 255).astype(np.uint8)
    return mesh.export(file_type="ply", encoding="ascii").decode()


@pytest.fixture
def scans_in(tmp_path, ball_text):
    """Write a manifest of balls with the given names; names that begin with "no" have no file."""

    def written(*names, folder="scans", **columns):
        place = tmp_path / folder
        place.mkdir(exist_ok=True)
        with (place / "manifest.csv").open("w", newline="") as file:
            table = csv.writer(file)
            table.writerow(["scan", *columns])
            for i, name in enumerate(names):
                table.writerow([f"{name}.ply", *(values[i] for values in columns.values())])
                if not name.startswith("no"):
                    # A comment makes each input another one.
                    (place / f"{name}.ply").write_text(
                        ball_text.replace("ply\n", f"ply\ncomment {name}\n", 1)
                    )
        return place / "manifest.csv"

    return written


@pytest.fixture
def layout(tmp_path):
    """Where the files of a batch are."""
    return Layout(tmp_path / "out")


@pytest.fixture
def out(layout):
    """The folder of a batch."""
    return layout.out


@pytest.fixture
def batched(scans_in, out):
    """Run a batch of balls, with columns of their manifest, into out."""

    def ran(*names, columns=None, options=TINY, **more):
        return run_batch(scans_in(*names, **(columns or {})), out, options=options, **more)

    return ran


def stand_in(diary):
    """Make what replaces the stages: two small files, or what the scan's name says."""

    # Everything is inside, so that it travels to workers by value.
    def written(task, layout):
        import os
        import signal
        import time
        from pathlib import Path

        from scan2albedo.io.input_hash import file_sha256

        tries = len(list(diary.glob(f"{task.name}@*")))
        (diary / f"{task.name}@{tries}").write_text(str(os.getpid()))
        sha256 = task.input_sha256()
        if task.name.startswith("kills") and (tries == 0 or "always" in task.name):
            os.kill(os.getpid(), signal.SIGKILL)
        if task.name.startswith("raises"):
            raise ZeroDivisionError("of a kind\nnobody thought of")
        if task.name.startswith("sleeps") and tries == 0:
            time.sleep(60)
        if task.name.startswith("waits"):
            time.sleep(0.5)
        folder = Path(task.out) / task.name
        folder.mkdir(exist_ok=True)
        (folder / "albedo.exr").write_text(task.name)
        (folder / "result.json").write_text(task.name)
        files = {path.name: file_sha256(path) for path in sorted(folder.iterdir())}
        lost = ("texture skin.jpg is missing: went on without it",) if task.name.startswith("bare") else ()
        return {"input_sha256": sha256, "files": files, "metrics": {"seconds": 1.0}, "notes": lost}

    return written


@pytest.fixture
def tries(tmp_path):
    """How often a scan was begun, by name."""
    (tmp_path / "diary").mkdir()
    return lambda name: len(list((tmp_path / "diary").glob(f"{name}@*")))


@pytest.fixture
def quick_stages(monkeypatch, tmp_path, tries):
    """Real workers, without the stages."""
    written = stand_in(tmp_path / "diary")

    def quick_task(task):
        from scan2albedo.batch import worker

        worker._processed = written
        return worker.process_task(task)

    monkeypatch.setattr(execution.worker, "process_task", quick_task)
    return tries


def processed_here(tasks, layout, jobs):
    yield from map(worker.process_task, tasks)


@pytest.fixture
def no_workers(monkeypatch, tmp_path, tries):
    """Neither workers nor stages."""
    monkeypatch.setattr(worker, "_processed", stand_in(tmp_path / "diary"))
    monkeypatch.setattr(run, "run_in_processes", processed_here)
    return tries


@pytest.fixture
def stages_in_this_process(monkeypatch):
    """The stages, without workers."""
    monkeypatch.setattr(run, "run_in_processes", processed_here)
