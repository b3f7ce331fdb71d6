"""README says nothing that is not so."""

import re
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_make_targets_exist():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in set(re.findall(r"\bmake (\w[\w-]*)", README)):
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target


def test_continuous_integration_runs_the_test_command():
    assert "make test" in (ROOT / ".ci" / "run").read_text(encoding="utf-8")


def test_commands_exist():
    from scan2albedo.cli import app

    commands = {command.name or command.callback.__name__ for command in app.registered_commands}
    named = set(re.findall(r"(?<!import )scan2albedo ([a-z][a-z-]+)", README)) - {
        "glasses",
        "experiment",
        "reflectance",
    }
    assert {"process", "relight", "identify", "personal-model"} <= named
    assert named <= commands
    from scan2albedo.glasses_cli import app as glasses

    commands = {command.name or command.callback.__name__ for command in glasses.registered_commands}
    assert set(re.findall(r"scan2albedo glasses (\w+)", README)) <= commands
    from scan2albedo.reflectance_cli import app as reflectance

    commands = {command.name or command.callback.__name__ for command in reflectance.registered_commands}
    assert set(re.findall(r"scan2albedo reflectance ([\w-]+)", README)) == commands
    from scan2albedo.experiments_cli import app as experiments

    commands = {command.name or command.callback.__name__ for command in experiments.registered_commands}
    assert set(re.findall(r"scan2albedo experiment (\w+)", README)) == commands


def test_named_folders_exist():
    for folder in re.findall(r"`(\w+)/`", README):
        assert (ROOT / "scan2albedo" / folder).is_dir() or (ROOT / folder).is_dir(), folder


@pytest.mark.slow
def test_python_examples_run(tmp_path, monkeypatch):
    """Every Python block, with a synthetic scan in place of the reader's."""
    import trimesh

    from scan2albedo.synthetic import raw_scan, wearer

    scan, _ = raw_scan(0)
    height, width = scan.texture_linear.shape[:2]
    uv = np.zeros((len(scan.vertices), 2))
    uv[scan.faces] = scan.uv
    column = np.clip((uv[:, 0] * width).astype(int), 0, width - 1)
    row = np.clip(((1 - uv[:, 1]) * height).astype(int), 0, height - 1)
    color = np.round(255 * scan.texture_linear[row, column] ** (1 / 2.2)).astype(np.uint8)
    mesh = trimesh.Trimesh(scan.vertices, scan.faces, vertex_colors=color, process=False)
    mesh.export(tmp_path / "subject.ply")
    monkeypatch.chdir(tmp_path)
    worn = wearer(0)
    frame = worn.glasses
    names = {
        "meshes": [(frame.rest_vertices, frame.faces), (frame.vertices, frame.faces)],
        "keypoints": [frame.rest_keypoints, frame.keypoints],
        "labels": worn.labels,
        "masks": worn.masks,
        "cameras": worn.cameras,
    }
    for block in re.findall(r"```python\n(.*?)```", README, re.DOTALL):
        exec(block.replace("subject.obj", "subject.ply"), names)
    assert names["albedo"].shape == (512, 512, 3)
    assert names["relit"].shape == (512, 512, 3)
    assert names["landmarks"].shape == (68, 3)
    assert names["picture"].shape == (256, 256, 3)
    assert names["between"].albedo_linear.shape == (512, 512, 3)
    assert names["frame"].deviation.shape == (len(frame.vertices),)
    assert (tmp_path / "out" / "subject" / "overview.png").is_file()
