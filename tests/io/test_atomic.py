import resource
from pathlib import Path

import numpy as np
import pytest

from scan2albedo.errors import OutputError
from scan2albedo.io.atomic import atomic_path, make_folder, write_text
from scan2albedo.io.images import write_exr, write_png


def test_a_good_block_leaves_the_file_and_nothing_else(tmp_path):
    with atomic_path(tmp_path / "a.txt") as temporary:
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".txt"
        temporary.write_text("new")
        assert not (tmp_path / "a.txt").exists()
    assert (tmp_path / "a.txt").read_text() == "new"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def _write_half(path, interruption):
    with atomic_path(path) as temporary:
        temporary.write_text("ha")
        raise interruption


@pytest.mark.parametrize("interruption", [KeyboardInterrupt, ValueError, SystemExit])
def test_an_interrupted_write_leaves_what_was_there(tmp_path, interruption):
    (tmp_path / "a.txt").write_text("old")
    with pytest.raises(interruption):
        _write_half(tmp_path / "a.txt", interruption)
    assert (tmp_path / "a.txt").read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(OutputError, match=r"a\.png into the folder .*nowhere: No such file"):
        write_png(tmp_path / "nowhere" / "a.png", np.zeros((2, 2)))
    with pytest.raises(OutputError, match=r"a\.exr into the folder .*nowhere: No such file"):
        write_exr(tmp_path / "nowhere" / "a.exr", np.zeros((2, 2)))


def test_a_read_only_folder_is_named():
    # /proc refuses new files even to root, for whom permissions do not count.
    if not Path("/proc").is_dir():
        pytest.skip("no /proc on this system")
    with pytest.raises(OutputError, match=r"a\.txt into the folder /proc"):
        write_text("/proc/a.txt", "x")
    with pytest.raises(OutputError, match=r"cannot create the folder /proc/out"):
        make_folder("/proc/out")


@pytest.fixture
def _full_disk():
    """A disk without space, in effect: no file may grow past 1000 bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.usefixtures("_full_disk")
def test_a_full_folder_keeps_the_old_file(tmp_path):
    write_text(tmp_path / "a.txt", "old")
    with pytest.raises(OutputError, match=r"a\.txt into the folder .*File too large.*space left"):
        write_text(tmp_path / "a.txt", "x" * 5000)
    noise = np.random.default_rng(0).random((64, 64, 3))
    with pytest.raises(OutputError, match=r"b\.png"):
        write_png(tmp_path / "b.png", noise)
    with pytest.raises(OutputError, match=r"b\.exr"):
        write_exr(tmp_path / "b.exr", noise)
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]
    assert (tmp_path / "a.txt").read_text() == "old"


def test_a_file_in_the_way_of_a_folder_is_named(tmp_path):
    (tmp_path / "out").write_text("I am a file")
    with pytest.raises(OutputError, match=r"cannot create the folder .*out"):
        make_folder(tmp_path / "out" / "james")
