"""A batch's page: its table from a catalogue or from the result files, failures, what is shown in full."""

import math
import sys
from datetime import datetime, timedelta

import pytest

from scan2albedo import report
from scan2albedo.errors import MissingDependencyError, Scan2AlbedoError
from scan2albedo.report.html.batch_section import (
    DONE,
    FAILED,
    RESIDUAL,
    UNCERTAINTY,
    ScanRow,
    batch_section,
    rows_of_catalogue,
    rows_of_folders,
    selected_rows,
)
from tests.report.pages import check, written

EVIL = "<img src=x onerror=alert(1)>"
SCRIPT = "</td><script>alert(1)</script>"
START = datetime(2026, 1, 1, 12)


def write_catalogue(out, entries, *schema):
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    out.mkdir(exist_ok=True)
    parquet.write_table(pyarrow.Table.from_pylist(entries, *schema), out / "catalogue.parquet")


def entry(name, status=DONE, **more):
    return {"name": name, "status": status, "reason": None, "folder": None, **more}


def test_result_files_make_the_table_and_a_damaged_one_is_a_failure_with_its_reason(some_scans, tmp_path):
    lines = []
    made = report.write_report(some_scans, tmp_path / "page.html", on_progress=lines.append)
    assert (made.scans, made.done, made.failed, made.sections) == (5, 4, 1, 4)
    assert len(lines) == 4
    page = check(made)
    words = page.words()
    assert "4 done 1 failed" in words
    assert "scan-9/result.json: the file: Invalid JSON" in words
    assert [row["data-status"] for row in page.all("tr") if "data-status" in row] == ["done"] * 4 + ["failed"]
    assert "#scan-1" in page.links()
    assert [d["id"] for d in page.all("details")] == ["scan-1", "scan-2", "scan-3", "scan-4"]


def done_rows(column, *values):
    """Return rows of scans that are done, with files, and with these values of a column."""
    return [ScanRow(str(k), DONE, folder=k, values={column: value}) for k, value in enumerate(values)]


def test_the_worst_are_shown():
    rows = [*done_rows(RESIDUAL, 1, 5, 3, 2, 4, 6), ScanRow("failed", FAILED, "why")]
    chosen, reason = selected_rows(rows, 4)
    assert chosen == (5, 1, 4, 2)
    assert reason == "4 of 6 scans, the worst by fit, mean"
    for count, expected in ((0, ()), (2, (5, 1)), (99, tuple(range(6)))):
        assert selected_rows(rows, count)[0] == expected


def test_scans_without_a_fit_are_chosen_by_their_albedo():
    assert selected_rows(done_rows(UNCERTAINTY, 0.1, 0.3, 0.2), 1)[0] == (1,)


def test_a_catalogue_makes_the_table_with_the_users_columns(write_scan, tmp_path):
    out = tmp_path / "batch"
    write_catalogue(
        out,
        [
            entry("anna", folder="anna", seconds=10.0, finished_at=START, worker="w1", cohort=EVIL, age=40),
            entry(EVIL, FAILED, reason=SCRIPT, finished_at=START, worker="w2", cohort="B"),
            entry("cleo", "not run", cohort="B", age=31),
            entry("gone", folder="gone", seconds=20.0, finished_at=START + timedelta(seconds=50)),
        ],
    )
    write_scan(out / "anna")
    made = report.write_report(out)
    assert (made.scans, made.done, made.failed, made.sections) == (4, 2, 1, 1)
    page = check(made)
    words = page.words()
    assert words.count(EVIL) == 2
    for told in (f"1× {SCRIPT}", "1 not run", "Cohort", "Age", "its files are not here"):
        assert told in words
    assert [a for a in page.all("img") if a.get("onerror")] == []
    ages = [c["data-value"] for c in page.all("td") if c.get("data-value") in ("40.0", "31.0")]
    assert ages == ["40.0", "31.0"]


def test_a_damaged_catalogue_and_one_of_something_else_are_refused_and_an_empty_one_is_not(tmp_path):
    pyarrow = pytest.importorskip("pyarrow")
    file = tmp_path / "catalogue.parquet"
    file.write_bytes(b"PAR1 but not really")
    with pytest.raises(Scan2AlbedoError, match=r"catalogue\.parquet: cannot be read as Parquet"):
        report.write_report(tmp_path)
    write_catalogue(tmp_path, [{"x": 1}])
    with pytest.raises(Scan2AlbedoError, match="no column name and no column status"):
        report.write_report(tmp_path)
    write_catalogue(tmp_path, [], pyarrow.schema({"name": "string", "status": "string"}))
    assert "0 done" in written(tmp_path).words()


def test_columns_of_any_type_become_text_or_numbers(tmp_path):
    more = {"stages": ["fit", "albedo"], "when": START, "share": math.nan, "good": True}
    write_catalogue(tmp_path, [entry("a", **more)])
    (row,) = rows_of_catalogue(tmp_path / "catalogue.parquet")
    assert row.values == {"stages": "fit, albedo", "when": "2026-01-01 12:00:00", "share": None, "good": True}
    assert row.number("good") is None


def test_without_pyarrow_the_extra_is_named(tmp_path, monkeypatch):
    write_catalogue(tmp_path, [entry("a")])
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(MissingDependencyError, match=r"pyarrow.*pip install 'scan2albedo\[report\]'"):
        rows_of_catalogue(tmp_path / "catalogue.parquet")


def test_a_table_that_would_be_too_long_keeps_failures(tmp_path):
    rows = [ScanRow(str(k), FAILED if k == 90 else DONE, values={"seconds": float(k)}) for k in range(100)]
    section = batch_section(rows, {50: "scan-51"}, tmp_path / "page.html", 10)
    assert len(section["rows"]) == 10
    assert section["rows_left_out"] == 90
    assert {"90", "50"} <= {row["name"] for row in section["rows"]}
    assert section["counts"] == {"done": 99, "failed": 1}
    running = batch_section([ScanRow("a", "running")], {}, tmp_path / "page.html", 10)
    assert running["counts"] == {"done": 0, "running": 1}


def test_distributions_are_of_the_scans_that_are_done(tmp_path):
    done = [{"seconds": 1.0 + k, "metrics_albedo_lights": k % 3} for k in range(30)]
    rows = [ScanRow("a", DONE, values=values) for values in (*done, {})]
    rows.append(ScanRow("f", FAILED, values={"seconds": 1e9}))
    lights, seconds = batch_section(rows, {}, tmp_path / "p.html")["distributions"]
    assert (lights["title"], seconds["title"]) == ("lights, median 1 ", "time, median 15.5 s")
    assert seconds["ends"] == ["1", "30"]
    assert [bar for bar in lights["bars"] if bar] == [1, 1, 1]


def test_rows_of_result_files_have_the_columns_of_a_catalogue(one_scan):
    (row,) = rows_of_folders(one_scan.parent)
    for name, value in {
        "metrics_fit_residual_mean_mm": 0.125,
        "metrics_albedo_uncertainty_direction_deviation_deg": 1.25,
        "seconds": 12.5,
        "seconds_albedo": 12.499,
        "plan_ran": "albedo.shadows",
        "plan_skipped": "fit",
    }.items():
        assert row.values[name] == value
