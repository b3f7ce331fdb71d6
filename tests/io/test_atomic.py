import os
import resource

import numpy as np
import pytest
from helpers.folders import contents

from scan2albedo.errors import OutputError
from scan2albedo.io.atomic import (
    atomic_path,
    check_writable,
    make_folder,
    removed_if_empty,
    write_text,
)
from scan2albedo.io.images import write_exr, write_png
from scan2albedo.io.publication import result_folder


def test_a_good_block_leaves_the_file_and_nothing_else(tmp_path):
    with atomic_path(tmp_path / "a.txt") as temporary:
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".txt"
        temporary.write_text("new")
        assert not (tmp_path / "a.txt").exists()
    assert contents(tmp_path) == {"a.txt": b"new"}


def write_half(block, name):
    with block as place:
        (place / name).write_text("ha")
        raise KeyboardInterrupt


def test_an_interrupted_write_leaves_what_was_there(tmp_path):
    file, out = tmp_path / "a.txt", tmp_path / "out"
    file.write_text("old")
    write_folder(out, {"result.json": "1"})
    before = contents(tmp_path)
    for block, name in ((atomic_path(file), ""), (result_folder(out), "result.json")):
        with pytest.raises(KeyboardInterrupt):
            write_half(block, name)
    assert contents(tmp_path) == before


@pytest.mark.parametrize(("write", "name"), [(write_png, "a.png"), (write_exr, "a.exr")])
def test_a_missing_folder_is_named(tmp_path, write, name):
    with pytest.raises(OutputError, match=rf"{name} into the folder .*nowhere: No such file"):
        write(tmp_path / "nowhere" / name, np.zeros((2, 2)))


@pytest.mark.skipif(not os.path.isdir("/proc"), reason="no /proc on this system")
def test_a_read_only_folder_is_named():
    # /proc refuses new files even to root, for whom permissions do not count.
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
    noise = np.random.default_rng(0).random((64, 64, 3))
    for write, name, content, words in (
        (write_text, "a.txt", "x" * 5000, " into the folder .*File too large.*space left"),
        (write_png, "b.png", noise, ""),
        (write_exr, "b.exr", noise, ""),
    ):
        with pytest.raises(OutputError, match=name + words):
            write(tmp_path / name, content)
    assert contents(tmp_path) == {"a.txt": b"old"}


def write_folder(out, files):
    with result_folder(out) as folder:
        for name, text in files.items():
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_text(text)


def test_files_replace_older_ones_also_in_folders(tmp_path):
    out = tmp_path / "a" / "b"
    write_folder(out, {"x.txt": "1", "y.txt": "1", "frame/z.txt": "1"})
    (out / "frame" / "mine.txt").write_text("kept")
    write_folder(out, {"x.txt": "2", "frame/z.txt": "2"})
    expected = {"frame": None, "frame/mine.txt": b"kept", "frame/z.txt": b"2", "x.txt": b"2", "y.txt": b"1"}
    assert contents(out) == expected


def test_a_link_in_a_result_folder_is_not_followed(tmp_path):
    out, mine = tmp_path / "out", tmp_path / "mine"
    write_folder(mine, {"x.txt": "mine"})
    out.mkdir()
    (out / "frame").symlink_to(mine)
    (out / "x.txt").symlink_to(mine / "x.txt")
    with pytest.raises(OutputError, match=r"out/frame is a link to another folder"):
        write_folder(out, {"frame/z.txt": "1"})
    write_folder(out, {"x.txt": "1"})
    assert contents(mine) == {"x.txt": b"mine"}


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_text("I am a file")
    for options in ({}, {"staged_in": tmp_path}):
        said = pytest.raises(OutputError, match=r"results into .*file/a: (Not a directory|File exists)")
        with said, result_folder(tmp_path / "file" / "a", **options):
            pass
    for make in (check_writable, make_folder):
        with pytest.raises(OutputError, match=r"cannot create the folder .*file"):
            make(tmp_path / "file" / "a")
    assert contents(tmp_path) == {"file": b"I am a file"}


def test_a_folder_made_for_nothing_goes_again(tmp_path):
    new = tmp_path / "new"
    with removed_if_empty(new):
        check_writable(new)
    assert not new.exists()
    with removed_if_empty(new):
        write_folder(new, {"x.txt": "1"})
    assert new.exists()
