"""A result folder is whole or as it was before."""

import os
from pathlib import Path

import pytest

from scan2albedo.errors import OutputError
from scan2albedo.io.result_folder import check_writable, remove_unfinished, removed_if_empty, result_folder


def contents(folder):
    return {str(p.relative_to(folder)): p.read_text() for p in folder.rglob("*") if p.is_file()}


def write(out, files, *records, **options):
    with result_folder(out, *records, **options) as folder:
        for name, text in files.items():
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_text(text)


def test_files_replace_older_ones_and_obsolete_ones_go(tmp_path):
    out = tmp_path / "a" / "b"
    write(out, {"x.txt": "1", "y.txt": "1", "result.json": "1"}, "result.json")
    (out / "mine.txt").write_text("kept")
    write(
        out, {"x.txt": "2", "result.json": "2"}, "result.json", obsolete=["x.txt", "y.txt", "../b/mine.txt"]
    )
    assert contents(out) == {"x.txt": "2", "result.json": "2", "mine.txt": "kept"}


def test_folders_inside_are_published_too_and_records_come_last(tmp_path, monkeypatch):
    order = []
    replace = os.replace
    monkeypatch.setattr(os, "replace", lambda a, b: (order.append(Path(b).name), replace(a, b)))
    files = {"set.json": "s", "x.txt": "1", "frame/result.json": "r", "frame/z.txt": "1"}
    write(tmp_path / "out", files, "set.json", "result.json")
    assert contents(tmp_path / "out") == files
    assert order == ["z.txt", "result.json", "x.txt", "set.json"]


def test_an_older_record_goes_before_other_files_change(tmp_path, monkeypatch):
    write(tmp_path, {"x.txt": "1", "result.json": "1"}, "result.json")

    def full(source, target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(OutputError, match=r"cannot write the results into .*: No space left on device"):
        write(tmp_path, {"x.txt": "2", "result.json": "2"}, "result.json")
    assert contents(tmp_path) == {"x.txt": "1"}


def write_half(out, interruption):
    with result_folder(out, "result.json") as folder:
        (folder / "result.json").write_text("ha")
        raise interruption


@pytest.mark.parametrize("interruption", [KeyboardInterrupt, ValueError])
def test_an_interrupted_block_leaves_what_was_there(tmp_path, interruption):
    write(tmp_path / "out", {"result.json": "1"}, "result.json")
    with pytest.raises(interruption):
        write_half(tmp_path / "out", interruption)
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["result.json"]
    assert contents(tmp_path / "out") == {"result.json": "1"}


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_text("I am a file")
    for options in ({}, {"staged_in": tmp_path}):
        with (
            pytest.raises(OutputError, match=r"cannot write the results into .*file/a: Not a directory"),
            result_folder(tmp_path / "file" / "a", **options),
        ):
            pass
    assert contents(tmp_path) == {"file": "I am a file"}
    with pytest.raises(OutputError, match="cannot create the folder"):
        check_writable(tmp_path / "file" / "a")


def test_an_exit_that_unwinds_nothing_can_remove_the_hidden_folder(tmp_path):
    with result_folder(tmp_path / "scan", staged_in=tmp_path) as folder:
        (folder / "x.txt").write_text("1")
        remove_unfinished(tmp_path)
        assert list(tmp_path.iterdir()) == []
        folder.mkdir()
    assert list(contents(tmp_path)) == []


def test_a_folder_made_for_nothing_goes_again(tmp_path):
    with removed_if_empty(tmp_path / "new"):
        check_writable(tmp_path / "new")
    assert not (tmp_path / "new").exists()
    with removed_if_empty(tmp_path / "new"):
        write(tmp_path / "new", {"x.txt": "1"})
    assert (tmp_path / "new").exists()
