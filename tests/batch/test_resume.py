"""What a second run keeps, and what it does again."""

import json
from dataclasses import replace

import pytest
from helpers.batches import TINY, stamps

from scan2albedo.batch import load_catalogue, read_manifest, run_batch
from scan2albedo.batch.run import _tasks
from scan2albedo.batch.worker import process_task
from scan2albedo.errors import BatchError
from scan2albedo.pipeline.options import ProcessOptions


def test_only_what_changed_is_done_again(scans_in, no_workers, out, layout):
    names = ("same", "input", "content", "missing", "row", "gone", "raises", "nofile")
    manifest = scans_in(*names)
    run_batch(manifest, out, options=TINY)
    before = stamps(out / "same")
    with (manifest.parent / "input.ply").open("a") as file:
        file.write("\n")
    (out / "content" / "albedo.exr").write_text("Content")  # as long as before
    (out / "missing" / "albedo.exr").unlink()
    layout.row_file("row").write_text('{"cut": ')
    (manifest.parent / "gone.ply").unlink()
    shown = []
    report = run_batch(manifest, out, options=TINY, resume=True, on_progress=shown.append)
    assert [no_workers(name) for name in names] == [1, 2, 2, 2, 2, 2, 2, 2]
    assert stamps(out / "same") == before
    assert (report.progress.kept, report.files_verified, report.progress.done) == (1, 2, 5)
    assert shown[0].note == (
        "kept 1 (hashes verified), 7 to do "
        "(1 with a changed scan, 2 with changed or missing files, 1 not run, "
        "1 without their scan, 2 failed before)"
    )
    rows = {row["name"]: row for row in load_catalogue(out).to_pylist()}
    assert rows["gone"]["status"] == "failed"
    assert (rows["gone"]["folder"], rows["gone"]["path_albedo_exr"]) == (None, None)
    assert "earlier run is still in its folder" in rows["gone"]["notes"]
    assert (out / "gone" / "albedo.exr").read_text() == "gone"
    assert (out / "content" / "albedo.exr").read_text() == "content"
    assert json.loads((out / "batch.json").read_text())["kept"] == 1


@pytest.mark.parametrize("change", [{"seed": 1}, {"size": 64}, {"pictures": True}, {"lights": 2}])
def test_another_option_does_all_again(batched, no_workers, change):
    for options in (TINY, replace(TINY, **change)):
        batched("a", options=options, resume=True)
    assert no_workers("a") == 2


def test_an_option_of_one_line_does_that_line_again(batched, no_workers):
    for seed in ("1", "2"):
        batched("a", "b", columns={"seed": ["", seed]}, resume=True)
    assert (no_workers("a"), no_workers("b")) == (1, 2)


def test_another_content_of_the_models_file_does_all_again(batched, tmp_path, no_workers):
    model = tmp_path / "model.obj"
    for text in ("v 0 0 0\n", "v 0 0 0\n", "v 0 0 1\n"):
        model.write_text(text)
        batched("a", options=ProcessOptions(model=str(model), size=32), resume=True)
    assert no_workers("a") == 2


def test_other_landmarks_do_their_scan_again(batched, tmp_path, no_workers):
    marks = tmp_path / "marks"
    marks.mkdir()
    for text in ("30,1,2,3\n", "30,1,2,3\n", "30,1,2,4\n"):
        (marks / "a.csv").write_text(text)
        batched("a", "b", options=replace(TINY, landmarks=marks), resume=True)
    assert (no_workers("a"), no_workers("b")) == (2, 1)
    one = replace(TINY, landmarks=marks / "a.csv")
    for columns in ({}, {"person": ["ann"] * 2}):
        with pytest.raises(ValueError, match="a folder with files named after the scans"):
            batched("a", "b", columns=columns, options=one, resume=True)


def test_another_scan_of_a_person_does_all_of_them_again(batched, scans_in, tmp_path, no_workers, out):
    options, ann = ProcessOptions(size=32), {"person": ["ann"] * 3}
    for count in (2, 2, 3):
        report = batched(*"abcd"[:count], columns=ann, options=options, resume=True)
        assert (report.progress.total, report.progress.done) == (1, 1)
    assert no_workers("ann") == 2
    manifest = scans_in(*"abc", **ann)
    scan = manifest.parent / "c.ply"
    scan.write_text(scan.read_text().replace("comment c", "comment other"))
    run_batch(manifest, out, options=options, resume=True)
    assert no_workers("ann") == 3
    (row,) = load_catalogue(out).to_pylist()
    assert (row["name"], row["person"], row["source"]) == ("ann", "ann", "a.ply, b.ply, c.ply")
    with pytest.raises(BatchError, match="line 2: a person needs the model of a face"):
        run_batch(manifest, tmp_path / "new", options=TINY)


def test_two_batches_in_one_folder_are_refused(scans_in, layout):
    with layout.locked(), pytest.raises(BatchError, match="a batch works in"):
        run_batch(scans_in("a"), layout.out, options=TINY, resume=True)


def test_a_worker_of_an_older_run_writes_nothing(scans_in, no_workers, layout):
    (task,) = _tasks(read_manifest(scans_in("raises")), layout, TINY, None)
    layout.begin_run("another")
    assert process_task(task).status == "failed"
    assert list(layout.rows.iterdir()) == []
