"""Manifests of tiny coloured balls, and a stand-in for the stages that is done at once."""

import csv

import numpy as np
import pytest

from scan2albedo.batch import execution



@pytest.fixture(scope="session")
def ball_text():
    """PLY of a coloured ball of 162 vertices, 180 mm wide."""
    import trimesh

    sphere = trimesh.creation.icosphere(2, 90.0)
    color = np.clip(128 + sphere.vertices, 0, 255).astype(int)
    head = [
        "ply\nformat ascii 1.0",
        f"element vertex {len(sphere.vertices)}",
        *(f"property float {axis}" for axis in "xyz"),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
        f"element face {len(sphere.faces)}\nproperty list uchar int vertex_indices\nend_header",
    ]
    points = [f"{x:.4f} {y:.4f} {z:.4f} {r} {g} {b}" for (x, y, z), (r, g, b) in zip(
        sphere.vertices, color, strict=True)]
    return "\n".join([*head, *points, *(f"3 {a} {b} {c}" for a, b, c in sphere.faces)]) + "\n"


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
                    (place / f"{name}.ply").write_text(ball_text.replace("ply\n", f"ply\ncomment {name}\n", 1))
        return place / "manifest.csv"

    return written


@pytest.fixture
def quick_stages(monkeypatch, tmp_path):
    """Workers that write two small files in place of the stages, or do what the scan's name says."""
    diary = tmp_path / "diary"
    diary.mkdir()

    def quick_task(task):
        import os
        import signal
        import time
        from pathlib import Path

        from scan2albedo.batch import worker
        from scan2albedo.batch.fingerprints import folder_sha256
        from scan2albedo.io.input_hash import input_sha256

        def written(task, layout):
            tries = len(list(diary.glob(f"{task.name}@*")))
            (diary / f"{task.name}@{tries}").write_text(str(os.getpid()))
            layout.forget(task.name)
            sha256 = input_sha256(task.path)
            if task.name.startswith("kills") and (tries == 0 or "always" in task.name):
                os.kill(os.getpid(), signal.SIGKILL)
            if task.name.startswith("raises"):
                raise ZeroDivisionError("of a kind\nnobody thought of")
            if task.name.startswith("sleeps"):
                time.sleep(60 if tries == 0 else 0)
            if task.name.startswith("waits"):
                time.sleep(0.5)
            folder = Path(task.out) / task.name
            folder.mkdir(exist_ok=True)
            (folder / "albedo.exr").write_text(task.name)
            (folder / "result.json").write_text(task.name)
            return {"input_sha256": sha256, "files": folder_sha256(folder), "metrics": {"seconds": 1.0}}

        worker._processed = written
        return worker.process_task(task)

    monkeypatch.setattr(execution.worker, "process_task", quick_task)

    def tries(name):
        return len(list(diary.glob(f"{name}@*")))

    return tries
