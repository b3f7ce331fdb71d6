"""What killed processes leave under hidden names goes with the next run; what others work on stays."""

import os
import subprocess
import sys
import time

import pytest

from scan2albedo.io import leftovers
from scan2albedo.io.atomic import atomic_path
from scan2albedo.io.leftovers import hidden_path, is_hidden_path, remove_leftovers, remove_unfinished
from scan2albedo.io.publication import result_folder

KILLED_WHILE_WRITING = """
import os, signal, sys
from pathlib import Path
from scan2albedo.io.atomic import atomic_path
from scan2albedo.io.publication import result_folder
out = Path(sys.argv[1])
with result_folder(out / "scan", staged_in=out) as folder, atomic_path(out / "a.json") as file:
    (folder / "albedo.exr").touch()
    file.touch()
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.fixture
def killed(tmp_path):
    """A folder in which a process was killed."""
    subprocess.run([sys.executable, "-c", KILLED_WHILE_WRITING, tmp_path], check=False)
    assert len(list(tmp_path.iterdir())) == 2
    return tmp_path


def test_the_next_result_removes_them(killed):
    with result_folder(killed / "other", staged_in=killed) as folder:
        (folder / "x.txt").touch()
    assert [path.name for path in killed.iterdir()] == ["other"]


def test_files_of_processes_that_run_stay(killed):
    earlier = killed / f".x-{leftovers._HOST}-{os.getpid()}-00000000.part"
    others = killed / f".x-{leftovers._HOST}-{os.getppid()}-00000000.part"
    for path in (earlier, others):
        path.touch()
    with atomic_path(killed / "mine.txt") as mine:
        mine.touch()
        assert remove_leftovers(killed, killed / "nowhere") == 3
        assert sorted(killed.iterdir()) == sorted([mine, others])
        remove_unfinished()
        assert list(killed.iterdir()) == [others]
        mine.touch()


def test_files_of_other_machines_stay_for_an_hour(killed, monkeypatch):
    monkeypatch.setattr(leftovers, "_HOST", "0" * 6)
    assert remove_leftovers(killed) == 0
    for path in killed.iterdir():
        os.utime(path, (time.time() - 4000,) * 2)
    assert remove_leftovers(killed) == 2


def test_hidden_files_of_others_and_links_stay(tmp_path):
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    names = [".mine.part", ".a-1-x1.part", ".b-12.part.json", "c.part", f".d-zzzzzz-{dead.pid}-00000000.part"]
    for name in names:
        (tmp_path / name).mkdir()
    (tmp_path / f".l-{leftovers._HOST}-{dead.pid}-00000000.part").symlink_to(tmp_path / "c.part")
    assert remove_leftovers(tmp_path) == 0
    assert len(list(tmp_path.iterdir())) == 6


@pytest.mark.parametrize("name", ["a.txt", "脸" * 80 + ".json", "x" * 255, ".hidden", "ends.with."])
def test_long_and_strange_names_have_a_hidden_one(tmp_path, name):
    with atomic_path(tmp_path / name) as path:
        assert is_hidden_path(path)
        assert path.suffix == ((tmp_path / name).suffix or ".part")
        path.touch()
    assert (tmp_path / name).is_file()
    assert not is_hidden_path(hidden_path(tmp_path / "x").with_name("x"))
