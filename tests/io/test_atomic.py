import resource
from pathlib import Path

import numpy as np
import pytest

from scan2albedo.errors import OutputError
from scan2albedo.io.atomic import (
    atomic_path,
    check_writable,
    make_folder,
    removed_if_empty,
    write_text,
)
from scan2albedo.io.images import write_exr, write_png
from scan2albedo.io.leftovers import remove_unfinished
from scan2albedo.io.publication import result_folder


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


def contents(folder):
    return {str(p.relative_to(folder)): p.read_text() for p in folder.rglob("*") if p.is_file()}


def write_folder(out, files):
    with result_folder(out) as folder:
        for name, text in files.items():
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_text(text)


def test_files_replace_older_ones_also_in_folders(tmp_path):
    out, files = tmp_path / "a" / "b", {"x.txt": "1", "y.txt": "1", "frame/z.txt": "1"}
    write_folder(out, files)
    (out / "frame" / "mine.txt").write_text("kept")
    write_folder(out, {"x.txt": "2", "frame/z.txt": "2"})
    assert contents(out) == files | {"x.txt": "2", "frame/z.txt": "2", "frame/mine.txt": "kept"}


def test_a_link_in_a_result_folder_is_not_followed(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "frame").symlink_to(tmp_path / "mine")
    (tmp_path / "x.txt").write_text("mine")
    (tmp_path / "out" / "x.txt").symlink_to(tmp_path / "x.txt")
    with pytest.raises(OutputError, match=r"out/frame is a link to another folder"):
        write_folder(tmp_path / "out", {"frame/z.txt": "1"})
    write_folder(tmp_path / "out", {"x.txt": "1"})
    assert (tmp_path / "x.txt").read_text() == "mine"
    assert list((tmp_path / "mine").iterdir()) == []


def write_half_a_folder(out, interruption):
    with result_folder(out) as folder:
        (folder / "result.json").write_text("ha")
        raise interruption


@pytest.mark.parametrize("interruption", [KeyboardInterrupt, ValueError])
def test_an_interrupted_block_leaves_the_folder_as_it_was(tmp_path, interruption):
    write_folder(tmp_path / "out", {"result.json": "1"})
    with pytest.raises(interruption):
        write_half_a_folder(tmp_path / "out", interruption)
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["result.json"]
    assert contents(tmp_path / "out") == {"result.json": "1"}


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_text("I am a file")
    for options in ({}, {"staged_in": tmp_path}):
        said = pytest.raises(OutputError, match=r"results into .*file/a: (Not a directory|File exists)")
        with said, result_folder(tmp_path / "file" / "a", **options):
            pass
    assert contents(tmp_path) == {"file": "I am a file"}
    with pytest.raises(OutputError, match="cannot create the folder"):
        check_writable(tmp_path / "file" / "a")


def test_an_exit_that_unwinds_nothing_can_remove_the_hidden_folder(tmp_path):
    with result_folder(tmp_path / "scan", staged_in=tmp_path) as folder:
        (folder / "x.txt").write_text("1")
        remove_unfinished()
        assert list(tmp_path.iterdir()) == []
        folder.mkdir()
    assert list(contents(tmp_path)) == []


def test_a_folder_made_for_nothing_goes_again(tmp_path):
    with removed_if_empty(tmp_path / "new"):
        check_writable(tmp_path / "new")
    assert not (tmp_path / "new").exists()
    with removed_if_empty(tmp_path / "new"):
        write_folder(tmp_path / "new", {"x.txt": "1"})
    assert (tmp_path / "new").exists()
