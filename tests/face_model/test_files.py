import os
from dataclasses import replace

import numpy as np
import pytest
from helpers.npz import rewritten
from helpers.records import files_in, read_json
from helpers.schemas import SCHEMAS, check_schema
from numpy.testing import assert_array_equal

from scan2albedo import AnnotatedFaceModel
from scan2albedo.errors import ModelError, OutputError
from scan2albedo.face_model.annotation import AnnotatedSurface, FaceModelFile
from scan2albedo.geometry.loop_subdivision import SurfacePoints

MODEL = AnnotatedFaceModel.default()
TEMPLATED = replace(
    MODEL,
    template_points=SurfacePoints(np.array([0, 5, 9]), np.full((3, 3), 1 / 3)),
    template_offset=np.arange(9.0).reshape(3, 3),
    template_faces=np.array([[0, 1, 2]]),
)


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "afm.json"
    MODEL.save(str(path))
    return path


def test_round_trip_keeps_every_bit(saved):
    again = AnnotatedSurface.load(saved)
    for name in ("control_vertices", "control_faces", "uv", "region", "landmarks"):
        assert_array_equal(getattr(again, name), getattr(MODEL, name))
    assert dict(again.regions) == dict(MODEL.regions)
    assert again.name == MODEL.name
    assert again.template_points is None


def test_round_trip_keeps_a_dense_template(tmp_path):
    uv = np.arange(6.0).reshape(1, 3, 2)
    model = replace(TEMPLATED, landmark_points=None, template_uv=uv, name="mine")
    model.save(tmp_path / "t.json")
    again = AnnotatedSurface.load(tmp_path / "t.json")
    assert again.landmarks is None
    assert_array_equal(again.template_points.face, model.template_points.face)
    assert_array_equal(again.template_points.barycentric, model.template_points.barycentric)
    for name in ("template_offset", "template_faces", "template_uv"):
        assert_array_equal(getattr(again, name), getattr(model, name))
    replace(model, template_faces=np.zeros((0, 3), int), template_uv=None).save(tmp_path / "t.json")
    assert AnnotatedSurface.load(tmp_path / "t.json").template_faces.shape == (0, 3)


def test_same_model_gives_the_same_bytes(saved, tmp_path):
    first = saved.read_bytes(), saved.with_suffix(".npz").read_bytes()
    AnnotatedSurface.load(saved).save(saved)
    assert (saved.read_bytes(), saved.with_suffix(".npz").read_bytes()) == first
    assert files_in(tmp_path) == {"afm.json", "afm.npz"}


def test_json_fits_the_shipped_schema(saved):
    check_schema(saved, "annotated_face_model", {"format": "other"})
    schema = read_json(SCHEMAS / "annotated_face_model.schema.json")
    generated = FaceModelFile.model_json_schema(mode="serialization")
    assert {k: v for k, v in schema.items() if k not in ("$schema", "$id")} == generated


def test_missing_files_are_named(saved):
    with pytest.raises(ModelError, match=r"nowhere\.json cannot be read \(No such file"):
        AnnotatedSurface.load(saved.with_name("nowhere.json"))
    saved.with_suffix(".npz").unlink()
    with pytest.raises(ModelError, match=r"afm\.npz cannot be read .*No such file.*copy it beside"):
        AnnotatedSurface.load(saved)


def test_a_broken_json_is_refused(saved):
    with pytest.raises(ModelError, match="is no UTF-8 text"):
        AnnotatedSurface.load(saved.with_suffix(".npz"))
    for text in ("", "{", "[]", "{}", '{"format": "scan2albedo-afm-9"}'):
        saved.write_text(text)
        with pytest.raises(ModelError, match=r"face model .*\(data_schemas/annotated_face_model"):
            AnnotatedSurface.load(saved)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.95])
def test_a_truncated_binary_is_refused(saved, share):
    binary = saved.with_suffix(".npz")
    os.truncate(binary, int(share * binary.stat().st_size))
    with pytest.raises(ModelError, match=r"afm\.npz cannot be read"):
        AnnotatedSurface.load(saved)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"uv": np.zeros((5, 2))}, r"uv in .* is of shape \(5, 2\).*do not belong together"),
        ({"uv": None}, "uv in .* is missing"),
        (
            {"control_vertices": np.where(MODEL.control_vertices > 80, np.nan, MODEL.control_vertices)},
            "control_vertices in .* holds NaN",
        ),
        ({"control_faces": MODEL.control_faces + 1}, "control_faces in .* points outside"),
        ({"region": np.append(MODEL.region[:-1], 200)}, r"region indices \[200\]"),
        ({"template_offset": np.zeros((2, 3))}, "template_offset in .* is of shape"),
        ({"template_faces": np.zeros((2, 3), np.int32)}, "template_faces in .* is of shape"),
        (
            {"template_faces": np.array([[0, 1, 3]], np.int32)},
            r"template_faces in .* points outside 0 \.\.\. 2",
        ),
    ],
)
def test_arrays_that_do_not_fit_are_refused(tmp_path, arrays, message):
    TEMPLATED.save(tmp_path / "t.json")
    rewritten(tmp_path / "t.npz", **arrays)
    with pytest.raises(ModelError, match=message):
        AnnotatedSurface.load(tmp_path / "t.json")


def test_saving_into_nowhere_is_an_output_error(tmp_path):
    with pytest.raises(OutputError, match="nowhere"):
        MODEL.save(tmp_path / "nowhere" / "afm.json")
