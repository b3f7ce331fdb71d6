"""The catalogue: columns of the same names and types, whatever became of the scans."""

from datetime import UTC, datetime

import duckdb
import pandas as pd
import pyarrow as pa
import pytest

from scan2albedo.batch.catalogue import catalogue_table, load_catalogue, write_catalogue
from scan2albedo.batch.manifest import BatchManifest, ManifestScan
from scan2albedo.batch.records import BatchScanRecord
from scan2albedo.errors import BatchError
from scan2albedo.io.result_records import InputRecord, ResultRecord
from scan2albedo.report.html.batch_section import row_of_record

SHA = "0" * 64


def manifest(tmp_path, *names):
    scans = [
        ManifestScan(name, f"{name}.ply", tmp_path / f"{name}.ply", extra={"age": "4"}) for name in names
    ]
    return BatchManifest(tmp_path / "list.csv", tuple(scans), ("age",))


def row(name, status="done", **more):
    return BatchScanRecord(
        run="r",
        name=name,
        source="old.ply",
        status=status,
        options_sha256=SHA,
        finished_at=datetime(2026, 1, 2, tzinfo=UTC),
        **more,
    )


DONE = {
    "model": "default annotated face model",
    "input_sha256": SHA,
    "seconds": 3,
    "metrics": {
        "seconds": 2,
        "fit": {"converged": True, "scale": float("nan")},
        "albedo": {"lights": 2, "parameters": {"brdf": "lambert"}, "uncertainty": {"x": [1, 2]}},
        "new-stage": {"figure": 7, "good": False},
    },
    "timings_s": {"load": 0.5, "files": 1},
    "plan_ran": ("register", "fit"),
    "plan_skipped": ("albedo.inpainting",),
    "notes": ("unit: mm", "only 36 % of the face has scan near it"),
    "files": {"albedo.exr": SHA, "result.json": SHA},
}


def test_a_row_tells_what_became_of_a_scan(tmp_path):
    rows = {"a": row("a", **DONE), "b": row("b", "failed", reason="no face")}
    a, b, c = catalogue_table(manifest(tmp_path, "a", "b", "c"), rows).to_pylist()
    expected = {
        "status": "done",
        "folder": "a",
        "source": "a.ply",
        "path_albedo_exr": "a/albedo.exr",
        "path_fitted_glb": None,
        "plan_ran": "register, fit",
        "plan_skipped": "albedo.inpainting",
        "notes": "unit: mm; only 36 % of the face has scan near it",
        "seconds": 3.0,
        "seconds_load": 0.5,
        "seconds_fit": None,
        "metrics_albedo_lights": 2.0,
        "metrics_fit_converged": True,
        "metrics_fit_scale": None,
        "metrics_new_stage_figure": 7.0,
        "metrics_new_stage_good": False,
        "age": "4",
        "finished_at": datetime(2026, 1, 2, tzinfo=UTC),
    }
    assert a.items() >= expected.items()
    assert (b["status"], b["folder"], b["reason"]) == ("failed", None, "no face")
    assert c["status"] == "not run"


def test_types_are_the_same_when_all_failed_and_none_was_run(tmp_path):
    scans = manifest(tmp_path, "a")
    none, failed, done = (
        catalogue_table(scans, rows).schema
        for rows in ({}, {"a": row("a", "failed")}, {"a": row("a", **DONE)})
    )
    assert none == failed
    own = ("metrics_new_stage", "metrics_albedo_uncertainty_x")
    assert [field for field in done if not field.name.startswith(own)] == list(none)
    kinds = {pa.string(), pa.float64(), pa.bool_(), pa.timestamp("us", tz="UTC")}
    assert set(done.types) == kinds


def test_a_report_has_the_same_metrics_from_the_catalogue_and_from_result_files(tmp_path):
    table = catalogue_table(manifest(tmp_path, "a"), {"a": row("a", **DONE)})
    (line,) = table.to_pylist()
    of_catalogue = {k: v for k, v in line.items() if k.startswith("metrics_") and v is not None}
    result = ResultRecord.model_construct(
        name="a",
        metrics=DONE["metrics"],
        timings_s={},
        plan=(),
        input=InputRecord.model_construct(file=None, sha256=SHA),
    )
    of_result = row_of_record(result, tmp_path).values
    shown = {k: v for k, v in of_result.items() if k.startswith("metrics_") and v == v}
    assert shown == of_catalogue
    assert shown["metrics_albedo_uncertainty_x"] == 2


def test_pandas_and_duckdb_read_it(tmp_path):
    rows = {"a": row("a", **DONE), "b": row("b", "failed")}
    path = tmp_path / "catalogue.parquet"
    write_catalogue(path, catalogue_table(manifest(tmp_path, "a", "b", "c"), rows))
    counts = duckdb.sql(f"SELECT status, count(*) FROM '{path}' GROUP BY status ORDER BY status").fetchall()
    assert counts == [("done", 1), ("failed", 1), ("not run", 1)]
    frame = pd.read_parquet(path)
    assert str(frame["finished_at"].dt.tz) == "UTC"
    assert list(frame["name"]) == list(load_catalogue(tmp_path).to_pandas()["name"]) == ["a", "b", "c"]


def test_none_and_a_damaged_one_are_told(tmp_path):
    with pytest.raises(BatchError, match="no such file"):
        load_catalogue(tmp_path)
    (tmp_path / "catalogue.parquet").write_bytes(b"PAR1 cut short")
    with pytest.raises(BatchError, match="no whole catalogue"):
        load_catalogue(tmp_path)
