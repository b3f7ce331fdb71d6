"""Results replace those of earlier runs and nothing else; a scan that fails changes nothing."""

from dataclasses import replace

import pytest
from helpers.folders import contents
from helpers.meshes import ball

import scan2albedo as s2a
from scan2albedo.errors import OutputError, ScanError
from scan2albedo.pipeline.process import write_result

TINY = {"model": "none", "size": 32, "unit": "mm", "pictures": False, "quality": "draft", "lights": 1}


@pytest.fixture(scope="module")
def result():
    return s2a.process(ball(), **TINY)


def linked(folder):
    (folder.parent / "other").mkdir()
    pointed_elsewhere(folder)


def pointed_elsewhere(folder):
    folder.rmdir()
    folder.symlink_to(folder.parent / "other")


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda folder: (folder / "notes.txt").write_text("mine"), "no result.json"),
        (lambda folder: (folder / "albedo.png").write_text("mine"), "no result.json"),
        (lambda folder: (folder / "result.json").write_text('{"mine": 1}'), "Field required"),
        (lambda folder: (folder / "result.json").write_bytes(b"\xff{"), "no UTF-8 text"),
        (lambda folder: (folder / "result.json").write_text("[" * 100_000), "result.json"),
        (lambda folder: (folder / "result.json").mkdir(), "result.json"),
        (linked, "is a link"),
        (pointed_elsewhere, "is a link"),
    ],
)
def test_a_folder_of_somebody_else_is_refused_before_any_work_and_stays(tmp_path, monkeypatch, make, words):
    folder = tmp_path / "out" / "ball"
    folder.mkdir(parents=True)
    make(folder)
    before = contents(tmp_path)
    monkeypatch.setattr("scan2albedo.pipeline.process.Run", None)  # no work is done
    with pytest.raises(OutputError, match=f"ball.*{words}"):
        s2a.process(ball(), tmp_path / "out", **TINY)
    assert contents(tmp_path) == before


def test_a_result_is_replaced_and_files_beside_it_stay(tmp_path, result):
    folder = write_result(result, tmp_path, pictures=False)
    (folder / "notes.txt").write_text("mine")
    (folder / "template.obj").write_text("not of the run, which had no template")
    before = contents(folder)
    with pytest.raises(OutputError, match=r"holds template\.obj, which no run of scan2albedo wrote"):
        write_result(result, tmp_path, pictures=False)
    assert contents(folder) == before
    (folder / "template.obj").unlink()
    write_result(replace(result, albedo=None), tmp_path, pictures=False)
    assert not (folder / "albedo.exr").exists()
    assert (folder / "notes.txt").read_text() == "mine"


def test_links_among_the_files_are_replaced_not_followed(tmp_path, result):
    folder = write_result(result, tmp_path / "out", pictures=False)
    (tmp_path / "mine.png").write_text("mine")
    (folder / "albedo.png").unlink()
    (folder / "albedo.png").symlink_to(tmp_path / "mine.png")
    write_result(result, tmp_path / "out", pictures=False)
    assert (tmp_path / "mine.png").read_text() == "mine"
    assert not (folder / "albedo.png").is_symlink()
    (folder / "result.json").rename(tmp_path / "result.json")
    (folder / "result.json").symlink_to(tmp_path / "result.json")
    with pytest.raises(OutputError, match=r"its result\.json is a link"):
        write_result(result, tmp_path / "out", pictures=False)


def test_a_scan_that_fails_changes_nothing(tmp_path, result):
    folder = write_result(result, tmp_path, pictures=False)
    before = contents(tmp_path)
    (tmp_path.parent / "ball.ply").write_bytes(b"ply\nno")
    with pytest.raises(ScanError, match=r"ball\.ply"):
        s2a.process(tmp_path.parent / "ball.ply", tmp_path, **TINY)
    assert contents(tmp_path) == before
    assert folder.name == "ball"


@pytest.mark.parametrize("name", ["../ball", "a/b", "..", "", "a\nb", "x" * 201])
def test_a_name_that_leads_elsewhere_is_refused(tmp_path, name):
    with pytest.raises(ValueError, match="expected a name that a folder can have"):
        s2a.process(ball(), tmp_path / "out", name=name, **TINY)
    assert list(tmp_path.iterdir()) == []
