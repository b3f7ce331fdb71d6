import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from scan2albedo import AnnotatedFaceModel
from scan2albedo.errors import ModelError, OutputError
from scan2albedo.face_model.annotation import AnnotatedSurface, FaceModelFile
from scan2albedo.geometry.loop_subdivision import SurfacePoints


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "afm.json"
    AnnotatedFaceModel.default().save(str(path))
    return path


def test_round_trip_keeps_every_bit(saved):
    model, again = AnnotatedFaceModel.default(), AnnotatedSurface.load(saved)
    for name in ("control_vertices", "control_faces", "uv", "region", "landmarks"):
        assert_array_equal(getattr(again, name), getattr(model, name))
    assert dict(again.regions) == dict(model.regions)
    assert again.name == model.name
    assert again.template_points is None


def test_round_trip_keeps_a_dense_template(tmp_path):
    points = SurfacePoints(np.array([0, 5, 9]), np.full((3, 3), 1 / 3))
    model = dataclasses.replace(
        AnnotatedFaceModel.default(),
        landmark_points=None,
        template_points=points,
        template_offset=np.arange(9.0).reshape(3, 3),
        template_faces=np.array([[0, 1, 2]]),
        template_uv=np.arange(6.0).reshape(1, 3, 2),
        name="mine",
    )
    model.save(tmp_path / "t.json")
    again = AnnotatedSurface.load(tmp_path / "t.json")
    assert again.landmarks is None
    assert_array_equal(again.template_points.face, points.face)
    assert_array_equal(again.template_points.barycentric, points.barycentric)
    assert_array_equal(again.template_offset, model.template_offset)
    assert_array_equal(again.template_faces, [[0, 1, 2]])
    assert_array_equal(again.template_uv, model.template_uv)


def test_a_dense_template_of_points_alone_is_read_again(tmp_path):
    points = SurfacePoints(np.array([0, 5, 9]), np.full((3, 3), 1 / 3))
    model = dataclasses.replace(
        AnnotatedFaceModel.default(), template_points=points, template_faces=np.zeros((0, 3), int)
    )
    model.save(tmp_path / "t.json")
    assert AnnotatedSurface.load(tmp_path / "t.json").template_faces.shape == (0, 3)


def test_same_model_gives_the_same_bytes(saved, tmp_path):
    first = saved.read_bytes(), saved.with_suffix(".npz").read_bytes()
    AnnotatedSurface.load(saved).save(saved)
    assert (saved.read_bytes(), saved.with_suffix(".npz").read_bytes()) == first
    assert sorted(p.name for p in tmp_path.iterdir()) == ["afm.json", "afm.npz"]


def test_json_fits_the_shipped_schema(saved):
    jsonschema = pytest.importorskip("jsonschema")
    file = Path(__file__).resolve().parents[2] / "data_schemas" / "annotated_face_model.schema.json"
    schema = json.loads(file.read_text())
    entry = json.loads(saved.read_text())
    jsonschema.validate(entry, schema)
    generated = FaceModelFile.model_json_schema(mode="serialization")
    assert {k: v for k, v in schema.items() if k not in ("$schema", "$id")} == generated
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(entry | {"format": "other"}, schema)


def test_missing_files_are_named(saved):
    with pytest.raises(ModelError, match=r"nowhere\.json cannot be read \(No such file"):
        AnnotatedSurface.load(saved.with_name("nowhere.json"))
    saved.with_suffix(".npz").unlink()
    with pytest.raises(ModelError, match=r"afm\.npz cannot be read .*No such file.*copy it beside"):
        AnnotatedSurface.load(saved)


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", '{"format": "scan2albedo-afm-9"}'])
def test_a_broken_json_is_refused(saved, text):
    saved.write_text(text)
    with pytest.raises(ModelError, match=r"face model .*\(data_schemas/annotated_face_model"):
        AnnotatedSurface.load(saved)


def test_the_binary_given_as_json_is_refused(saved):
    with pytest.raises(ModelError, match="is no UTF-8 text"):
        AnnotatedSurface.load(saved.with_suffix(".npz"))


@pytest.mark.parametrize("share", [0.0, 0.3, 0.95])
def test_a_truncated_binary_is_refused(saved, share):
    binary = saved.with_suffix(".npz")
    data = binary.read_bytes()
    binary.write_bytes(data[: int(share * len(data))])
    with pytest.raises(ModelError, match=r"afm\.npz cannot be read"):
        AnnotatedSurface.load(saved)


def change_arrays(path, **arrays):
    binary = path.with_suffix(".npz")
    with np.load(binary) as stored:
        kept = {n: stored[n] for n in stored.files}
    kept |= arrays
    np.savez_compressed(binary, **{n: a for n, a in kept.items() if a is not None})


def test_files_that_do_not_belong_together_are_refused(saved):
    change_arrays(saved, uv=np.zeros((5, 2)))
    with pytest.raises(ModelError, match=r"uv in .* is of shape \(5, 2\).*do not belong together"):
        AnnotatedSurface.load(saved)
    change_arrays(saved, uv=None)
    with pytest.raises(ModelError, match=r"uv in .* is missing"):
        AnnotatedSurface.load(saved)


def test_bad_numbers_are_refused(saved):
    model = AnnotatedFaceModel.default()
    vertices = model.control_vertices.copy()
    vertices[3, 1] = np.nan
    change_arrays(saved, control_vertices=vertices)
    with pytest.raises(ModelError, match=r"control_vertices in .* holds NaN"):
        AnnotatedSurface.load(saved)
    faces = model.control_faces.copy()
    faces[0, 0] = len(vertices)
    change_arrays(saved, control_vertices=model.control_vertices, control_faces=faces)
    with pytest.raises(ModelError, match=r"control_faces in .* points outside"):
        AnnotatedSurface.load(saved)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"template_offset": np.zeros((2, 3))}, "template_offset in .* is of shape"),
        ({"template_faces": np.zeros((2, 3), np.int32)}, "template_faces in .* is of shape"),
        (
            {"template_faces": np.array([[0, 1, 3]], np.int32)},
            r"template_faces in .* points outside 0 \.\.\. 2",
        ),
    ],
)
def test_a_template_that_does_not_fit_is_refused(tmp_path, arrays, message):
    model = dataclasses.replace(
        AnnotatedFaceModel.default(),
        template_points=SurfacePoints(np.array([0, 5, 9]), np.full((3, 3), 1 / 3)),
        template_offset=np.zeros((3, 3)),
        template_faces=np.array([[0, 1, 2]]),
    )
    model.save(tmp_path / "t.json")
    change_arrays(tmp_path / "t.json", **arrays)
    with pytest.raises(ModelError, match=message):
        AnnotatedSurface.load(tmp_path / "t.json")


def test_unknown_region_is_refused(saved):
    region = AnnotatedFaceModel.default().region.copy()
    region[0] = 200
    change_arrays(saved, region=region)
    with pytest.raises(ModelError, match=r"region indices \[200\]"):
        AnnotatedSurface.load(saved)


def test_saving_into_nowhere_is_an_output_error(tmp_path):
    with pytest.raises(OutputError, match="nowhere"):
        AnnotatedFaceModel.default().save(tmp_path / "nowhere" / "afm.json")
