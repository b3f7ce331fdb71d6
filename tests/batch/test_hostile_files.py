"""Damaged, strange and hostile files: each is a row of the catalogue, and the other scans are processed."""

import os

import pytest

from scan2albedo.batch import load_catalogue, run_batch
from scan2albedo.pipeline.options import ProcessOptions

TINY = ProcessOptions(model="none", size=32, unit="mm", pictures=False, skip=("albedo",))
pytestmark = pytest.mark.usefixtures("stages_in_this_process", "no_endless_reading")


@pytest.fixture
def scans(tmp_path, ball_text):
    """A folder with one good scan, the last by name."""
    folder = tmp_path / "scans"
    folder.mkdir()
    (folder / "~good.ply").write_text(ball_text)
    return folder


def deep_json(folder, ball):
    (folder / "deep.gltf").write_text('{"nodes":' + "[" * 200_000)


def pipe(folder, ball):
    os.mkfifo(folder / "pipe.obj")


def device(folder, ball):
    (folder / "zero.ply").symlink_to("/dev/zero")


def link_to_itself(folder, ball):
    (folder / "loop.ply").symlink_to(folder / "loop.ply")


def rows_of(folder, out, manifest=None):
    """Run a batch and return its rows by source."""
    run_batch(folder if manifest is None else manifest, out, options=TINY, jobs=1)
    run_batch(folder if manifest is None else manifest, out, options=TINY, jobs=1, resume=True)
    return {row["source"]: row for row in load_catalogue(out).to_pylist()}


@pytest.mark.parametrize(
    ("made", "source", "words"),
    [
        (deep_json, "deep.gltf", "recursion"),
        (pipe, "pipe.obj", "is a pipe or a device"),
        (device, "zero.ply", "is a pipe or a device"),
        (link_to_itself, "loop.ply", "symbolic links"),
    ],
)
def test_a_file_that_cannot_be_read_fails_alone(scans, tmp_path, ball_text, made, source, words):
    made(scans, ball_text)
    rows = rows_of(scans, tmp_path / "out")
    assert rows[source]["status"] == "failed"
    assert words in rows[source]["reason"]
    assert rows["~good.ply"]["status"] == "done"


@pytest.mark.parametrize(
    ("name", "source", "folder"),
    [
        (b"latin-\xe9.ply", r"latin-\xe9.ply", "latin-_-1c514124"),
        (b"evil\x1b[31m\n.ply", r"evil\x1b[31m\x0a.ply", "evil_[31m_-1fb6c72c"),
        (b"x" * 251 + b".ply", "x" * 251 + ".ply", "x" * 191 + "-90d738c3"),
    ],
)
def test_a_scan_of_a_strange_name_has_a_folder_of_a_plain_one(
    scans, tmp_path, ball_text, name, source, folder
):
    with open(os.path.join(os.fsencode(scans), name), "w") as file:
        file.write(ball_text)
    rows = rows_of(scans, tmp_path / "out")
    assert rows[source]["status"] == "done"
    assert rows[source]["name"] == folder
    assert (tmp_path / "out" / folder / "result.json").is_file()
    assert rows["~good.ply"]["status"] == "done"


def test_names_that_no_file_can_have_fail_alone(scans, tmp_path):
    manifest = tmp_path / "list.txt"
    long, many = "y" * 300 + ".ply", "z/" * 3000 + "z.ply"
    manifest.write_text(f"{long}\n{many}\nscans/~good.ply\n")
    rows = rows_of(scans, tmp_path / "out", manifest)
    for name in (long, many):
        assert rows[name]["status"] == "failed"
        assert "File name too long" in rows[name]["reason"]
    assert rows["scans/~good.ply"]["status"] == "done"


def test_cells_of_a_table_are_in_the_catalogue_without_what_a_terminal_obeys(scans, tmp_path):
    (tmp_path / "t.csv").write_text('scan,"co\x1b[0mhort"\nscans/~good.ply,"\x1b[31mred\nline"\n')
    (row,) = rows_of(scans, tmp_path / "out", tmp_path / "t.csv").values()
    assert row[r"co\x1b[0mhort"] == r"\x1b[31mred\x0aline"
