"""`process(..., linear_model=FILE)`: coefficients.json, the mesh in its place, the texture on its UV."""

import numpy as np
import pytest
from helpers.meshes import ball
from helpers.records import files_in, read_json
from numpy.testing import assert_allclose, assert_array_equal

import scan2albedo as s2a
from scan2albedo.errors import ModelError
from scan2albedo.face_model.variation import IDENTITY_BUMPS, displacement
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.io.linear_model_files import LinearFaceModel

CHOSEN = {"size": 64, "quality": "draft", "texture_size": 128}


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """A linear model of the default model's surface, in centimetres, with texture coordinates."""
    model = s2a.AnnotatedFaceModel.default()
    vertices, faces = model.surface(1)
    modes = [displacement(bump, vertices, model.landmarks) for bump in IDENTITY_BUMPS[:10]]
    path, basis = tmp_path_factory.mktemp("model") / "bumps.npz", np.stack(modes, -1)
    np.savez(path, mean=vertices / 10, basis=basis / 10, faces=faces, uv=model.refined_uv(1))
    return path


@pytest.fixture(scope="module")
def result(coarse_scan, file, tmp_path_factory):
    return s2a.process(coarse_scan[0], tmp_path_factory.mktemp("out"), linear_model=file, **CHOSEN)


@pytest.mark.slow
def test_files_place_the_model_on_the_scan(result, file):
    record = read_json(result.out / "coefficients.json")
    model = LinearFaceModel.load(file)
    assert (record["model"], record["model_sha256"]) == ("bumps", model.sha256)
    assert (len(record["shape"]), record["expression"], record["mm_per_unit"]) == (10, [], pytest.approx(10))
    assert record["scale"] == pytest.approx(1, abs=0.1)
    with np.load(result.out / "linear_model.npz") as arrays:
        stored = dict(arrays)
    placed = transform_points(record["scan_from_model"], model.at(np.array(record["shape"])))
    assert_allclose(placed, stored["vertices"], atol=1e-5)
    near = ~np.isnan(stored["residual_mm"])
    assert near.mean() > 0.5
    assert np.median(stored["residual_mm"][near]) < 1.5
    assert (np.abs(stored["displacement_mm"][near]) <= stored["residual_mm"][near] + 1e-9).all()
    assert_array_equal(np.isnan(stored["displacement_mm"]), ~near)


def test_the_template_is_the_linear_model_with_its_texture(result, file):
    assert {"template.obj", "template.png", "template.glb"} <= files_in(result.out)
    own = read_json(result.out / "result.json")["template_from_model"]
    back = transform_points(own, result.template.vertices)
    assert_allclose(back, LinearFaceModel.load(file).at(result.linear_model.coefficients), atol=1e-6)
    assert result.template.tiles[0].seen.mean() > 0.3


def test_plan_trace_and_metrics_name_the_stage(result):
    assert result.plan.ran("linear_model")
    assert "linear_model" in result.trace.stages
    assert result.metrics()["linear_model"]["noise_mm"] > 0
    assert result.options["linear_model"].endswith("bumps.npz")


def test_what_cannot_be_fitted_is_refused(file, tmp_path):
    for call, given, error, words in (
        (s2a.process, {"model": "none"}, ValueError, "linear_model needs the model of a face"),
        (s2a.process, {"linear_model": tmp_path / "none.npz"}, ModelError, r"none\.npz: No such file"),
        (s2a.process_person, {}, ValueError, "linear_model is fitted to single scans"),
        (s2a.process_sequence, {"name": "t"}, ValueError, "linear_model is fitted to single scans"),
    ):
        scans = ball() if call is s2a.process else [ball()]
        with pytest.raises(error, match=words):
            call(scans, **{"linear_model": file} | given)
