"""Nothing in the names and texts of files is obeyed by a terminal."""

import json
import re

import numpy as np
import pytest
from helpers.cli import invoke
from helpers.commands import refusal, succeeded
from helpers.meshes import obj_text, sphere

from scan2albedo.cli import progress
from scan2albedo.core import TraceRow
from scan2albedo.errors import Scan2AlbedoError

EVIL = "\x1b]0;owned\x07\x1b[2J\n\r\x9b31m"


def raw(text):
    """What of a text a terminal would obey; line ends are ours."""
    return re.findall(r"[\x00-\x09\x0b-\x1f\x7f-\x9f]", text)


@pytest.fixture
def scan(tmp_path):
    """A ball with a name, a material and a texture that are not harmless."""
    vertices, faces = sphere(2)
    path = tmp_path / f"ball{EVIL}.obj"
    mesh = obj_text(vertices, faces, np.zeros((len(vertices), 2)))
    path.write_text(f"mtllib a.mtl\nusemtl skin\x1b[31m\n{mesh}")
    (tmp_path / "a.mtl").write_text("newmtl skin\x1b[31m\nmap_Kd lost\x1b[2J.png\n")
    return path


def test_a_processed_scan(scan, tmp_path):
    asked = ("--model", "none", "--size", 32, "--json")
    done = succeeded(invoke("process", scan, "-o", tmp_path / "out", *asked))
    assert r"texture lost\x1b[2J.png is missing" in done.stderr
    (folder,) = (tmp_path / "out").iterdir()
    record = (folder / "result.json").read_text()
    assert raw(done.stderr + done.stdout + folder.name + record) == []
    assert EVIL not in json.loads(record)["input"]["file"]


def test_errors_of_the_scan_and_of_the_usage(tmp_path):
    scan = tmp_path / f"a{EVIL}.obj"
    scan.write_text("v 0 0 x\x1b[2J\n")
    failed = invoke("process", scan, "-o", tmp_path / "out")
    assert refusal(failed)
    assert raw(failed.stderr) == []
    for wrong in (
        ("process", scan, scan.with_name(scan.name), "-o", tmp_path / "out"),
        ("process", scan, "-o", tmp_path / "out", "--unit", EVIL),
        ("batch", scan, "-o", tmp_path / "out", "--jobs", EVIL),
        ("report", tmp_path / EVIL),
        ("relight", tmp_path / EVIL, "-o", "x.png", "--light", "0,0"),
        ("relight", tmp_path, "-o", f"x{EVIL}.txt", "--light", "0,0"),
        (f"no{EVIL}command",),
    ):
        said = invoke(*wrong)
        assert said.exit_code != 0
        assert isinstance(said.exception, SystemExit | Scan2AlbedoError)
        assert raw(str(said.exception) + said.stderr) == []


def test_the_bar_takes_no_name_for_markup(monkeypatch, capsys):
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    with progress.ProgressLines(f"[/red]{EVIL}") as lines:
        lines.update(TraceRow("fit", 0.0, 0.0, 1, 1.0, "mm"))
    assert "\x9b" not in capsys.readouterr().err
