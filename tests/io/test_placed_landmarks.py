"""Landmarks placed by hand are read as people and programs write them."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

from scan2albedo import load_scan
from scan2albedo.errors import ScanError
from scan2albedo.io.landmark_files import LandmarksRecord, landmarks_file, read_landmarks, write_landmarks_csv
from scan2albedo.io.records import write_record

POINTS = {30: (1.0, 2.0, 3.0), 8: (4.0, -5.0, 6.5)}
PICKED = """<!DOCTYPE PickedPoints>
<PickedPoints>
 <DocumentData><DataFileName name="face.obj"/></DocumentData>
 <point x="1" y="2" z="3" active="1" name="30"/>
 <point x="4" y="-5" z="6.5" name="8"/>
 <point x="7" y="7" z="7" active="0" name="new point"/>
</PickedPoints>
"""
TEXTS = {
    "header.csv": "number,x,y,z\n30,1,2,3\n8,4,-5,6.5\n",
    "other columns.csv": "part;number;x;y;z;who\nnose;30;1;2;3;me\nchin;8;4;-5;6.5;me\nbrow;20;;;;\n",
    "no header.txt": "30, 1, 2, 3\n8, 4, -5, 6.5\n",
    "with null where none was placed.json": json.dumps(
        [*[None] * 8, [4, -5, 6.5], *[None] * 21, [1, 2, 3], *[None] * 37]
    ),
    "mapping.json": '{"30": [1, 2, 3], "8": [4, -5, 6.5]}',
    "picked.pp": PICKED,
}


@pytest.mark.parametrize("name", TEXTS)
def test_every_format_says_the_same(name, tmp_path):
    (tmp_path / name).write_text(TEXTS[name])
    found = read_landmarks(tmp_path / name, mm_per_unit=10.0)
    assert np.flatnonzero(found.placed).tolist() == sorted(POINTS)
    for number, point in POINTS.items():
        assert_allclose(found.points[number], 10 * np.array(point))


def test_what_process_wrote_is_read_back_with_its_deviations(tmp_path):
    points, deviation_mm = np.random.default_rng(0).normal(size=(68, 3)), np.linspace(1, 3, 68)
    record = LandmarksRecord.of(points + 5, points, deviation_mm, 10.0)
    write_record(tmp_path / "a.json", record)
    write_landmarks_csv(tmp_path / "a.csv", record)
    for name in ("a.json", "a.csv"):
        found = read_landmarks(tmp_path / name, mm_per_unit=10.0)
        assert_allclose(found.points, 10 * points, rtol=1e-6)
        assert_allclose(found.sigma_mm, deviation_mm, atol=0.01)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.csv", "number,x,y,z\n68,1,2,3\n", "line 2: '68' is not the number of a landmark"),
        ("a.csv", "number,x,y,z\n30,1,two,3\n", "line 2: 'two' is not a finite number"),
        ("a.csv", "number,x,y,z\n30,1,2,3\n30,1,2,4\n", r"line 3: landmark 30 was given before \(.*line 2\)"),
        ("a.csv", "number,x,y\n30,1,2\n", "has no columns x, y and z"),
        ("a.csv", "1,2,3\n", "line 1: .* are not three coordinates"),
        ("a.csv", "", "no landmark among"),
        ("a.csv", "number,x,y,z,sigma_mm\n30,1,2,3,0\n", "above 0"),
        ("a.csv", "number,x,y,z\n" + "30,1,2,3\n" * 40_000, r"cannot be read \(360,013 bytes are more than"),
        ("a.csv", None, r"landmarks .*a\.csv cannot be read"),
        ("a.json", "{", "is no JSON"),
        ("a.json", "[" * 100_000, "is no JSON"),
        ("a.json", '{"30": [1, 2, NaN]}', "'nan' is not a finite number"),
        ("a.json", '{"30": [1, 2, true]}', "'True' is not a finite number"),
        ("a.json", '{"landmarks": 5}', "holds no landmarks"),
        ("a.pp", "<a><b></a>", "not a file of picked points"),
        ("a.pp", '<a><point x="1" y="2" z="3" name="nose"/></a>', "'nose' is not the number of a landmark"),
        ("a.pp", '<a><point x="1" y="2" name="30"/></a>', "'None' is not a finite number"),
        ("a.xyz", "", "read from .csv, .json and .pp"),
    ],
)
def test_what_is_wrong_is_named_with_its_place(name, text, message, tmp_path):
    if text is not None:
        (tmp_path / name).write_text(text)
    with pytest.raises(ScanError, match=message) as caught:
        read_landmarks(tmp_path / name)
    assert name in str(caught.value)


def test_a_folder_has_a_file_named_after_the_scan(tmp_path):
    (tmp_path / "anna.pp").write_text(PICKED)
    assert landmarks_file(tmp_path, "scans/anna.obj") == tmp_path / "anna.pp"
    assert landmarks_file(tmp_path, "scans/otto.obj") is None
    assert landmarks_file(tmp_path / "anna.pp", "scans/otto.obj") == tmp_path / "anna.pp"


def test_a_scan_is_loaded_with_landmarks_in_its_own_unit(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 0.2 0 0\nv 0 0.2 0.1\nf 1 2 3\n")
    scan = load_scan(tmp_path / "a.obj", landmarks={30: (0.1, 0.1, 0.05)})
    assert_allclose(scan.landmarks.points[30], (100, 100, 50))
    assert scan.notes[-1] == "1 landmarks given"
    (tmp_path / "marks").mkdir()
    without = load_scan(tmp_path / "a.obj", landmarks=tmp_path / "marks")
    assert without.landmarks is None
    assert "no landmarks of this scan" in without.notes[-1]
    with pytest.raises(ScanError, match="an option of `process`"):
        load_scan(tmp_path / "a.obj", landmarks="Auto")
    with pytest.raises(ValueError, match="landmarks is empty"):
        load_scan(tmp_path / "a.obj", landmarks="")
