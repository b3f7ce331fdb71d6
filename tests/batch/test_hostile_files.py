"""Damaged, strange and hostile files: each is a row of the catalogue, and the other scans are processed."""

import os
from dataclasses import replace

import pytest
from helpers.batches import TINY

from scan2albedo.batch import load_catalogue, run_batch

pytestmark = pytest.mark.usefixtures("stages_in_this_process", "no_endless_reading")


@pytest.fixture
def scans(tmp_path, ball_text):
    """A folder with one good scan, the last by name."""
    folder = tmp_path / "scans"
    folder.mkdir()
    (folder / "~good.ply").write_text(ball_text)
    return folder


def rows_of(manifest, out):
    """Run a batch and return its rows by source."""
    options = replace(TINY, skip=("albedo",))
    for resume in (False, True):
        run_batch(manifest, out, options=options, jobs=1, resume=resume)
    return {row["source"]: row for row in load_catalogue(out).to_pylist()}


@pytest.mark.parametrize(
    ("name", "make", "words"),
    [
        ("deep.gltf", lambda file: file.write_text('{"nodes":' + "[" * 200_000), "recursion"),
        ("pipe.obj", os.mkfifo, "is a pipe or a device"),
        ("zero.ply", lambda file: file.symlink_to("/dev/zero"), "is a pipe or a device"),
        ("loop.ply", lambda file: file.symlink_to(file), "symbolic links"),
    ],
)
def test_a_file_that_cannot_be_read_fails_alone(scans, name, make, words, out):
    make(scans / name)
    rows = rows_of(scans, out)
    assert rows[name]["status"] == "failed"
    assert words in rows[name]["reason"]
    assert rows["~good.ply"]["status"] == "done"


@pytest.mark.parametrize(
    ("name", "source", "folder"),
    [
        (b"latin-\xe9.ply", r"latin-\xe9.ply", "latin-_-1c514124"),
        (b"evil\x1b[31m\n.ply", r"evil\x1b[31m\x0a.ply", "evil_[31m_-1fb6c72c"),
        (b"x" * 251 + b".ply", "x" * 251 + ".ply", "x" * 191 + "-90d738c3"),
    ],
)
def test_a_scan_of_a_strange_name_has_a_folder_of_a_plain_one(scans, ball_text, name, source, folder, out):
    with open(os.path.join(os.fsencode(scans), name), "w") as file:
        file.write(ball_text)
    rows = rows_of(scans, out)
    assert rows[source]["status"] == "done"
    assert rows[source]["name"] == folder
    assert (out / folder / "result.json").is_file()
    assert rows["~good.ply"]["status"] == "done"


def test_names_that_no_file_can_have_fail_alone(scans, tmp_path, out):
    manifest = tmp_path / "list.txt"
    long, many = "y" * 300 + ".ply", "z/" * 3000 + "z.ply"
    manifest.write_text(f"{long}\n{many}\nscans/~good.ply\n")
    rows = rows_of(manifest, out)
    for name in (long, many):
        assert rows[name]["status"] == "failed"
        assert "File name too long" in rows[name]["reason"]
    assert rows["scans/~good.ply"]["status"] == "done"


def test_cells_of_a_table_are_in_the_catalogue_without_what_a_terminal_obeys(scans, tmp_path, out):
    (tmp_path / "t.csv").write_text('scan,"co\x1b[0mhort"\nscans/~good.ply,"\x1b[31mred\nline"\n')
    (row,) = rows_of(tmp_path / "t.csv", out).values()
    assert row[r"co\x1b[0mhort"] == r"\x1b[31mred\x0aline"
