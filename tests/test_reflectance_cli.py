"""The commands for reflectance, from pictures to samples of a model."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from scan2albedo.cli import app
from scan2albedo.errors import ReflectanceError
from scan2albedo.io.reflectance_json import ReflectanceRecord
from scan2albedo.io.result_json import read_record
from scan2albedo.reflectance import MorphableReflectanceModel, read_reflectance
from scan2albedo.reflectance_demo import write_synthetic_capture
from scan2albedo.synthetic import FlashCaptureOptions, flash_capture

OPTIONS = FlashCaptureOptions(views=3, flashes=4, picture_size=96, levels=1)


def run(*arguments):
    return CliRunner().invoke(app, ["reflectance", *map(str, arguments)])


@pytest.fixture(scope="module")
def captures():
    return [flash_capture(seed, options=OPTIONS) for seed in (0, 1)]


@pytest.fixture(scope="module")
def people(captures, tmp_path_factory):
    """Folder with captures and fits of two people."""
    folder = tmp_path_factory.mktemp("people")
    for seed, capture in enumerate(captures):
        write_synthetic_capture(capture, folder / f"capture_{seed}")
        done = run("fit", folder / f"capture_{seed}" / "capture.json", "-o", folder / f"fit_{seed}")
        assert done.exit_code == 0, done.output
    return folder


def test_olat_writes_a_linear_picture_a_pair(people, tmp_path):
    done = run("olat", people / "capture_0" / "capture.json", "-o", tmp_path / "olat", "--json")
    assert done.exit_code == 0, done.output
    figures = json.loads(done.stdout)
    assert figures["pairs"] == 12
    assert len(list((tmp_path / "olat").glob("olat_*.exr"))) == 12
    record = read_record(tmp_path / "olat" / "reflectance.json", ReflectanceRecord)
    assert set(record.files) == {path.name for path in (tmp_path / "olat").iterdir()}


def test_fit_writes_what_its_record_says(people):
    folder = people / "fit_0"
    record = read_record(folder / "reflectance.json", ReflectanceRecord)
    assert set(record.files) == {path.name for path in folder.iterdir()}
    assert {"reflectance.npz", "overview.png", "relit.png", "trace.csv", "face.ply"} <= set(record.files)
    assert record.metrics["held_out"]["pairs"] == 1
    assert 0 < record.metrics["held_out"]["relative_rmse"] < 0.3
    mesh = read_reflectance(folder / "reflectance.npz")
    assert mesh.reflectance.known.sum() == record.metrics["known_vertices"] > 2500


def test_fitted_albedo_is_that_of_the_person(people, captures):
    truth = captures[0]
    one = read_reflectance(people / "fit_0" / "reflectance.npz").reflectance
    ratio = one.diffuse_linear[one.known] / truth.diffuse_linear[one.known]
    assert np.median(np.abs(ratio - 1)) < 0.08


def test_build_and_sample(people, tmp_path):
    model_folder = tmp_path / "model"
    done = run("build", people / "fit_0", people / "fit_1" / "reflectance.npz", "-o", model_folder, "--json")
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["components"] == 1
    model = MorphableReflectanceModel.load(model_folder / "reflectance_model.npz")
    assert model.samples == 2
    for out in ("a", "b"):
        done = run("sample", model_folder, "-o", tmp_path / out, "--count", 2, "--seed", 5)
        assert done.exit_code == 0, done.output
    files = sorted(path.name for path in (tmp_path / "a").iterdir())
    assert files == ["reflectance.json", "sample_000.npz", "sample_001.npz", "samples.png"]
    one, again = (read_reflectance(tmp_path / out / "sample_001.npz") for out in ("a", "b"))
    assert np.array_equal(one.reflectance.weights, again.reflectance.weights, equal_nan=True)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("fit", "{people}/capture_0/capture.json", "-o", "{out}", "--loss", "huber"), "loss is 'huber'"),
        (("fit", "{people}/capture_0/capture.json", "-o", "{out}", "--held-out-every", "1"), "held-out"),
        (("fit", "{people}/capture_0/capture.json", "-o", "{out}", "--budget", "-1"), "must be > 0"),
        (("build", "{people}/fit_0", "-o", "{out}", "--least-support", "0"), "least-support"),
        (("sample", "{people}/fit_0", "-o", "{out}", "--count", "0"), "count"),
    ],
)
def test_wrong_options_are_usage_errors(people, tmp_path, arguments, told):
    done = run(*(word.format(people=people, out=tmp_path / "out") for word in arguments))
    assert done.exit_code == 2
    assert told in " ".join(done.output.split())
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("olat", "{people}/none.json", "-o", "{out}"), "none.json"),
        (("fit", "{people}/fit_0/reflectance.json", "-o", "{out}"), "flash_capture.schema.json"),
        (("build", "{people}/capture_0", "-o", "{out}"), "neither"),
        (("build", "{people}/fit_0/overview.png", "-o", "{out}"), "overview.png"),
        (("sample", "{people}/fit_0", "-o", "{out}"), "reflectance_model.npz"),
        (("sample", "{people}/fit_0/reflectance.npz", "-o", "{out}"), "is no folder"),
    ],
)
def test_wrong_files_are_named_and_leave_nothing(people, tmp_path, arguments, told):
    done = run(*(word.format(people=people, out=tmp_path / "out") for word in arguments))
    assert done.exit_code != 0
    assert told in str(done.exception)
    assert not (tmp_path / "out").exists()


def test_faces_of_other_topology_make_no_model(people, captures, tmp_path):
    other = captures[1]
    from scan2albedo.reflectance import MeshReflectance, VertexReflectance, write_reflectance
    from scan2albedo.reflectance_model_run import build_model

    known = np.ones(len(other.vertices), bool)
    one = VertexReflectance(other.diffuse_linear, other.weights, known)
    write_reflectance(tmp_path / "other.npz", MeshReflectance(other.vertices, other.faces[:-1], one))
    with pytest.raises(ReflectanceError, match=r"other\.npz has other triangles"):
        build_model([people / "fit_0", tmp_path / "other.npz"])
