import json
import math
from pathlib import Path

import numpy as np
import pytest
from helpers.schemas import check_schema
from pydantic import ValidationError

from scan2albedo.core.lights import EnvironmentLight, PointLight
from scan2albedo.core.plan import PlanStep
from scan2albedo.errors import Scan2AlbedoError
from scan2albedo.io.records import installed_versions, plain_json, read_record, write_record
from scan2albedo.io.result_records import (
    InputRecord,
    RegistrationRecord,
    ResultRecord,
)

LAMP = PointLight(0.5, -0.25, 900.0, 2, (1.5, 1.0, 0.5), 8.0)
SOFT = EnvironmentLight(np.arange(27.0).reshape(9, 3), occluded=False, fill=0.25, bounce=0.3)


def result():
    return ResultRecord(
        scan2albedo_version="0.1.0",
        versions=installed_versions(),
        name="james",
        seed=3,
        options={"size": 512, "skip": (), "model": Path("a/b.json"), "budget_seconds": None},
        input=InputRecord(
            file="james.obj", sha256="a" * 64, vertices=6393, faces=12228, texture_size=(2400, 1600)
        ),
        plan=(PlanStep(stage="albedo.shadows", ran=True, reason="cast shadows", evidence="3.1 % of texels"),),
        metrics={"fit": {"mean_mm": np.float32(0.25), "worst_mm": np.nan, "flips": np.int64(0)}},
        lights=(PointLight(math.pi / 6, -math.pi / 4), LAMP),
        environment=SOFT,
        parameters={"light_distance_mm": math.inf, "sh_coefficients": np.eye(3), "brdf": "oren-nayar"},
        timings_s={"fit": np.float64(1.5)},
        notes=("unit: mm",),
        files=("albedo.exr",),
    )


def registration():
    return RegistrationRecord(
        model_from_scan=np.arange(16.0).reshape(4, 4),
        rmse_mm=0.8,
        depth_error=None,
        converged=True,
        confidence=0.9,
        iterations=120,
    )


def test_lights_survive_and_older_records_hold_white_points():
    written = result().model_dump_json()
    read = ResultRecord.model_validate_json(written)
    assert read.lights[1] == LAMP
    back = read.environment
    assert np.array_equal(back.coefficients, SOFT.coefficients)
    assert (back.occluded, back.fill, back.bounce) == (False, 0.25, 0.3)
    light = {"azimuth_deg": 0, "elevation_deg": 0, "distance_mm": None, "intensity": 1}
    step = {"stage": "fit", "ran": False, "reason": "why"}
    tree = json.loads(written) | {"lights": [light], "plan": [step]}
    older = ResultRecord.model_validate(tree)
    assert older.lights == (PointLight(0, 0),)
    assert older.plan == (PlanStep("fit", False, "why"),)
    assert older.plan[0].level == "left out"
    for change in ({"lights": [light | {"intensity": -1}]}, {"plan": [step | {"x": 1}]}):
        with pytest.raises(ValidationError):
            ResultRecord.model_validate(tree | change)


@pytest.mark.parametrize("record", [result(), registration()], ids=["result", "registration"])
def test_what_is_written_is_read_back_and_fits_its_schema(tmp_path, record):
    write_record(tmp_path / "a.json", record)
    read = read_record(tmp_path / "a.json", type(record))
    assert read.model_dump_json() == record.model_dump_json()
    name = type(record).__name__.removesuffix("Record").lower()
    tree = check_schema(tmp_path / "a.json", name, {"surprise": 1})
    assert plain_json(tree) == tree


def test_values_become_plain_json():
    tree = json.loads(result().model_dump_json())
    first, second = tree["lights"]
    assert first["azimuth_deg"] == pytest.approx(30)
    assert first["elevation_deg"] == pytest.approx(-45)
    assert first["distance_mm"] is None
    assert second["distance_mm"] == 900
    assert tree["metrics"]["fit"] == {"mean_mm": 0.25, "worst_mm": None, "flips": 0}
    assert tree["parameters"]["light_distance_mm"] is None
    assert tree["parameters"]["sh_coefficients"][1] == [0, 1, 0]
    assert tree["options"]["model"] == "a/b.json"
    assert json.loads(registration().model_dump_json())["model_from_scan"][1] == [4, 5, 6, 7]


@pytest.mark.parametrize(
    "change", [{"rmse_mm": math.nan}, {"rmse_mm": -1}, {"model_from_scan": np.eye(3)}, {"surprise": 1}]
)
def test_wrong_values_are_refused(change):
    with pytest.raises(ValidationError):
        RegistrationRecord(**{**registration().model_dump(), **change})


def test_reading_names_the_file_and_the_fault(tmp_path):
    path = tmp_path / "result.json"
    text = result().model_dump_json(indent=2)
    with pytest.raises(Scan2AlbedoError, match=r"result\.json cannot be read \(No such file"):
        read_record(path, ResultRecord)
    for content, kind, said in (
        (text[: len(text) // 2], ResultRecord, "the file: Invalid JSON"),
        (text.replace('"seed": 3', '"seed": "three"'), ResultRecord, "seed: .*integer"),
        (text, RegistrationRecord, "model_from_scan: Field required"),
    ):
        path.write_text(content)
        with pytest.raises(Scan2AlbedoError, match=rf"result\.json: {said}"):
            read_record(path, kind)


def test_versions_name_what_numbers_depend_on():
    versions = installed_versions()
    assert {"python", "numpy", "scipy", "embreex"} <= versions.keys()
    assert versions["numpy"] == np.__version__
