"""A batch replaces and removes what batches wrote, and nothing else."""

import json
import os

import pytest
from helpers.folders import contents
from helpers.records import files_in, read_json

from scan2albedo.batch import load_albedos, load_catalogue
from scan2albedo.batch.catalogue import write_catalogue
from scan2albedo.errors import BatchError, OutputError
from scan2albedo.io.leftovers import JOURNAL
from scan2albedo.report import write_report

pytestmark = pytest.mark.usefixtures("stages_in_this_process")


def test_a_folder_of_somebody_else_fails_its_scan_alone(batched, tmp_path, out):
    for name, file in (("a", "albedo.png"), ("b", "result.json"), ("nofile", "template.obj")):
        (out / name).mkdir(parents=True)
        (out / name / file).write_text("mine")
    (tmp_path / "mine").mkdir()
    (out / "linked").symlink_to(tmp_path / "mine")
    before = contents(out)
    report = batched("a", "b", "linked", "nofile", "good")
    assert sorted(report.failures) == ["a", "b", "linked", "nofile"]
    assert all("no run of scan2albedo wrote it" in report.failures[name] for name in ("a", "b", "nofile"))
    assert "is a link" in report.failures["linked"]
    assert {name: contents(out)[name] for name in before} == before
    assert contents(tmp_path / "mine") == {}


def test_a_hostile_journal_fails_its_scan_alone(batched, out):
    batched("a", "b")
    journal = {"holder": ".x-000000-1-00000000.part", "made": [], "dropped": ["../b/albedo.exr"]}
    (out / "a" / JOURNAL).write_text(json.dumps(journal))
    before = contents(out / "a"), contents(out / "b")
    report = batched("a", "b", resume=True)
    assert list(report.failures) == ["a"]
    assert "is not ours" in report.failures["a"]
    assert (contents(out / "a"), contents(out / "b")) == before


def test_an_edited_result_of_a_batch_is_made_again(batched, out):
    folder = out / "a"
    batched("a")
    (folder / "result.json").write_text("{")
    (folder / "notes.txt").write_text("mine")
    assert batched("a", resume=True).failures == {}
    assert read_json(folder / "result.json")["name"] == "a"
    assert (folder / "notes.txt").read_text() == "mine"
    assert batched("a", resume=True).progress.kept == 1  # notes do not count


@pytest.mark.parametrize(
    ("file", "text", "words"),
    [
        ("batch.json", '{"mine": 1}', "batch.json: .*none of a batch"),
        ("batch.json", "[" * 100_000, "batch.json: "),
        ("catalogue.parquet", "mine", "is no whole catalogue"),
    ],
)
def test_a_record_or_catalogue_of_somebody_else_is_refused(batched, file, text, words, out):
    out.mkdir()
    (out / file).write_text(text)
    for resume in (False, True):
        with pytest.raises(BatchError, match=words if resume else "holds a batch already"):
            batched("a", resume=resume)
    assert (out / file).read_text() == text
    assert not (out / "a").exists()


def test_links_in_the_place_of_records_are_not_followed(batched, tmp_path, out):
    records, mine = out / ".batch", tmp_path / "mine"
    mine.mkdir()
    (mine / "a.json").write_text("mine")
    records.parent.mkdir()
    records.symlink_to(mine)
    with pytest.raises(BatchError, match=r"\.batch: is a link"):
        batched("a")
    records.unlink()
    records.mkdir()
    (records / "running").symlink_to(mine)
    with pytest.raises(BatchError, match=r"running: is a link"):
        batched("a")
    assert contents(mine) == {"a.json": b"mine"}


def test_files_that_an_edited_record_names_elsewhere_are_not_read(batched, layout):
    batched("a")
    row = layout.row_file("a")
    record = read_json(row)
    record["files"] = {"/dev/zero": "0" * 64, **record["files"]}
    row.write_text(json.dumps(record))
    report = batched("a", resume=True)
    assert (report.progress.kept, report.progress.done) == (0, 1)


def pipe(file):
    file.unlink()
    os.mkfifo(file)


@pytest.mark.parametrize(
    "change",
    [
        pipe,
        lambda row: row.write_text("[" * 100_000),
        lambda row: row.write_bytes(bytes(range(256))),
        lambda row: row.write_text(row.read_text().replace('"status": "done"', '"status": 1e999')),
        lambda row: row.write_text(row.read_text().replace('"metrics": {', '"metrics": {"x": NaN, "y":')),
        lambda row: (row.unlink(), row.mkdir()),
    ],
    ids=["pipe", "deep", "bytes", "huge", "cut", "folder"],
)
def test_a_scan_whose_record_was_edited_is_done_again_or_fails_alone(batched, change, layout):
    batched("a", "b")
    row = layout.row_file("a")
    change(row)
    if row.is_dir():
        with pytest.raises(OutputError, match=r"a\.json"):
            batched("a", "b", resume=True)
        return
    report = batched("a", "b", resume=True)
    assert (report.progress.kept, report.progress.done, report.failures) == (1, 2, {})


def test_marks_that_are_none_are_left_alone(batched, layout):
    running = layout.running
    running.mkdir(parents=True)
    os.mkfifo(running / "pipe")
    (running / "deep").write_text("[" * 100_000)
    (running / "a").write_text('{"pid": 1, "started_at": 1.0}')
    assert batched("a").progress.done == 1
    assert files_in(running) == {"deep", "pipe"}


def edited(out, name, value):
    """Replace what a column of a catalogue with one scan holds."""
    table = load_catalogue(out)
    column = table.column_names.index(name)
    write_catalogue(out / "catalogue.parquet", table.set_column(column, name, [[value]]))
    return table


@pytest.mark.parametrize("path", ["../mine/albedo.exr", "/mine/albedo.exr", "albedo.exr", "link/albedo.exr"])
def test_a_catalogue_that_names_files_elsewhere_is_refused(batched, path, out):
    batched("a")
    (out / "link").symlink_to(out / "a")
    table = edited(out, "path_albedo_exr", path)
    with pytest.raises(BatchError, match="no file of a scan in it"):
        load_albedos(out)
    write_catalogue(out / "catalogue.parquet", table.drop_columns("path_albedo_exr"))
    with pytest.raises(BatchError, match="has no column path_albedo_exr"):
        load_albedos(out)


def test_a_report_reads_no_folder_elsewhere(batched, out):
    batched("a")
    edited(out, "folder", "../out/a")
    assert write_report(out).sections == 0
    assert "names a folder that is not in that of the batch" in (out / "report.html").read_text()
