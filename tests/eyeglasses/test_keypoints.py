"""Names, skeleton and files of key points."""

import json
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses import KEY_POINT_NAMES, read_keypoints, write_keypoints
from scan2albedo.eyeglasses.keypoints import MIRROR, SKELETON

SCHEMA = Path(__file__).resolve().parents[2] / "data_schemas" / "eyeglasses_keypoints.schema.json"


def test_the_skeleton_joins_all_20_and_is_symmetric():
    assert len(KEY_POINT_NAMES) == len(set(KEY_POINT_NAMES)) == 20
    for name, other in zip(KEY_POINT_NAMES, MIRROR, strict=True):
        swapped = name.replace("left", "LEFT").replace("right", "left").replace("LEFT", "right")
        assert KEY_POINT_NAMES[other] == swapped
    graph = coo_matrix((np.ones(len(SKELETON)), np.transpose(SKELETON)), (20, 20))
    assert connected_components(graph)[0] == 1
    edges = {frozenset(edge) for edge in SKELETON}
    assert {frozenset((MIRROR[a], MIRROR[b])) for a, b in SKELETON} == edges


def test_files_keep_key_points_and_fit_their_schema(tmp_path):
    points = np.random.default_rng(0).normal(0, 50, (20, 3))
    points[4] = np.nan
    write_keypoints(tmp_path / "a.json", points)
    np.testing.assert_array_equal(read_keypoints(tmp_path / "a.json"), points)
    schema, tree = json.loads(SCHEMA.read_text()), json.loads((tmp_path / "a.json").read_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.validate(tree, schema)
    for wrong in ({"surprise": 1}, {"key_points": {"nose": [1, 2, 3]}}, {"unit": "inch"}):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate({**tree, **wrong}, schema)


def test_a_name_left_out_is_a_missing_key_point(tmp_path):
    write_keypoints(tmp_path / "a.json", np.ones((20, 3)))
    tree = json.loads((tmp_path / "a.json").read_text())
    del tree["key_points"]["left_hinge"]
    (tmp_path / "a.json").write_text(json.dumps(tree))
    missing = np.isnan(read_keypoints(tmp_path / "a.json")).all(1)
    assert np.array(KEY_POINT_NAMES)[missing].tolist() == ["left_hinge"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "Invalid JSON"),
        ('{"key_points": {"nose": [1, 2, 3]}}', "'nose' is no key point"),
        ('{"key_points": {"left_hinge": [1, 2]}}', "left_hinge"),
        ('{"format_version": 2, "key_points": {}}', "format_version"),
    ],
)
def test_faults_name_the_file(tmp_path, text, message):
    (tmp_path / "broken.json").write_text(text)
    with pytest.raises(EyeglassesError, match=rf"broken\.json.*{message}"):
        read_keypoints(tmp_path / "broken.json")


def test_no_file_and_no_text_name_the_file(tmp_path):
    with pytest.raises(EyeglassesError, match=r"none\.json: .*No such file"):
        read_keypoints(tmp_path / "none.json")
    (tmp_path / "binary.json").write_bytes(b"\xff\xfe\x80")
    with pytest.raises(EyeglassesError, match=r"binary\.json: is no text"):
        read_keypoints(tmp_path / "binary.json")
    with pytest.raises(ValueError, match=r"\(20, 3\), got \(19, 3\)"):
        write_keypoints(tmp_path / "a.json", np.zeros((19, 3)))
