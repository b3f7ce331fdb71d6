"""The commands for reflectance, from pictures to samples of a model."""

import dataclasses
import json
import shutil
from contextlib import suppress

import cv2
import numpy as np
import pytest
import trimesh
from helpers.cli import invoke
from helpers.commands import printed, succeeded
from helpers.records import files_in, read_json
from helpers.usage import usage_error
from worlds.environments import generated_environment

from scan2albedo.errors import ReflectanceError
from scan2albedo.io.records import read_record
from scan2albedo.reflectance import (
    MorphableReflectanceModel,
    read_photograph,
    read_reflectance,
    write_reflectance,
)
from scan2albedo.runs.reflectance import ReflectanceRecord
from scan2albedo.runs.reflectance.demo import write_synthetic_capture, write_synthetic_photograph
from scan2albedo.runs.reflectance.image_run import corresponding
from scan2albedo.runs.reflectance.model_run import build_model, read_model_folder
from scan2albedo.synthetic import Portrait, face_photograph, flash_capture

pytestmark = pytest.mark.slow

SMALL = Portrait(picture_size=96)


def run(out, *arguments):
    return invoke("reflectance", *arguments, "-o", out)


def figures_of(out, *arguments):
    """Return the figures of a command that has to end well."""
    return printed(run(out, *arguments, "--json"))


def refused(out, told, *arguments):
    """Check that a command names what is wrong, and writes nothing."""
    done = run(out, *arguments)
    assert done.exit_code != 0
    for word in told:
        assert word in str(done.exception)
    assert not out.exists()


@pytest.fixture
def out(tmp_path):
    return tmp_path / "out"


def record_of(folder):
    """Return the record of a run, which names all its files."""
    record = read_record(folder / "reflectance.json", ReflectanceRecord)
    assert set(record.files) == files_in(folder)
    return record


@pytest.fixture(scope="module")
def captures():
    return [flash_capture(seed, views=3, flashes=4, levels=1, portrait=SMALL) for seed in (0, 1)]


@pytest.fixture(scope="module")
def people(captures, tmp_path_factory):
    """Folder with captures and fits of two people."""
    folder = tmp_path_factory.mktemp("people")
    for seed, capture in enumerate(captures):
        write_synthetic_capture(capture, folder / f"capture_{seed}")
        succeeded(run(folder / f"fit_{seed}", "fit", folder / f"capture_{seed}" / "capture.json"))
    return folder


def test_olat_writes_a_linear_picture_a_pair(people, out):
    assert figures_of(out, "olat", people / "capture_0" / "capture.json")["pairs"] == 12
    assert len(list(out.glob("olat_*.exr"))) == 12
    record_of(out)


def test_fit_writes_what_its_record_says(people, captures):
    folder = people / "fit_0"
    record = record_of(folder)
    assert {"reflectance.npz", "overview.png", "relit.png", "trace.csv", "face.ply"} <= set(record.files)
    assert record.metrics["held_out"]["pairs"] == 1
    assert 0 < record.metrics["held_out"]["relative_rmse"] < 0.3
    found = read_reflectance(folder / "reflectance.npz").reflectance
    assert found.known.sum() == record.metrics["known_vertices"] > 2500
    ratio = found.diffuse_linear[found.known] / captures[0].diffuse_linear[found.known]
    assert np.median(np.abs(ratio - 1)) < 0.08


def test_build_and_sample(people, tmp_path):
    built = figures_of(tmp_path, "build", people / "fit_0", people / "fit_1" / "reflectance.npz")
    assert built["components"] == 1
    assert MorphableReflectanceModel.load(tmp_path / "reflectance_model.npz").samples == 2
    weights = []
    for out in (tmp_path / "a", tmp_path / "b"):
        succeeded(run(out, "sample", tmp_path, "--count", 2, "--seed", 5))
        assert files_in(out) == {"reflectance.json", "sample_000.npz", "sample_001.npz", "samples.png"}
        weights.append(read_reflectance(out / "sample_001.npz").reflectance.weights)
    assert np.array_equal(*weights, equal_nan=True)


@pytest.fixture(scope="module")
def model(people, captures):
    """Folder of a model of two people, with shapes."""
    capture = captures[0]
    distance = np.linalg.norm(capture.landmarks[:, None] - capture.vertices[None], axis=2)
    (people / "landmarks.json").write_text(json.dumps(distance.argmin(1).tolist()))
    landmarks = ("--landmark-vertices", people / "landmarks.json")
    succeeded(run(people / "model", "build", people / "fit_0", people / "fit_1", *landmarks))
    return people / "model"


@pytest.fixture(scope="module")
def photographs(people):
    """Photograph files of three others; the last without a mesh."""
    return [
        write_synthetic_photograph(
            face_photograph(10 + k, generated_environment(k), lights=24, portrait=SMALL),
            people / f"photograph_{k}",
            mesh=k < 2,
        )
        for k in range(3)
    ]


def test_fit_image_with_a_mesh(model, photographs, out):
    figures = figures_of(out, "fit-image", photographs[0], "--model", model)
    assert 0 < figures["relative_rmse"] < 0.4
    assert len(figures["light_harmonics"]) == 81
    assert "geometry" not in figures
    record_of(out)
    assert read_reflectance(out / "reflectance.npz").reflectance.known.any()


def test_fit_image_from_landmarks(model, photographs, out):
    figures = figures_of(out, "fit-image", photographs[2], "--model", model)
    assert 0 < figures["geometry"]["landmark_rmse_px"] < 8
    trace = (out / "trace.csv").read_text()
    assert "reflectance.geometry.landmarks" in trace
    assert "reflectance.image" in trace


def test_fit_image_without_a_model_takes_the_default_one_and_says_what_it_believes(photographs, out):
    figures = figures_of(out, "fit-image", photographs[2])
    assert [step["stage"].split(".")[-1] for step in figures["plan"]] == ["details", "person", "hue"]
    assert figures["beats_mean"] == any(step["ran"] for step in figures["plan"])
    record = record_of(out)
    assert record.inputs == (str(photographs[2]),)
    assert figures["beats_mean"] != any("mean face" in note for note in record.notes)


def test_build_from_synthetic_people(out):
    assert figures_of(out, "build", "--synthetic", 12)["samples"] == 12
    assert (out / "shape_model.npz").is_file()


def test_a_photograph_without_gamma_is_told(model, photographs, tmp_path):
    file = spoiled(photographs[0], tmp_path / "raw", lambda content, _: content.pop("gamma"))
    for name, command in (
        ("fitted", ("fit-image", file, "--model", model)),
        ("tuned", ("finetune", model, file, "--held-out", photographs[1])),
    ):
        succeeded(run(tmp_path / name, *command, "--budget", "1"))
        notes = record_of(tmp_path / name).notes
        assert sum("photograph.json gives no gamma" in note for note in notes) == 1


def test_landmarks_without_a_shape_model_are_refused(people, photographs, out, tmp_path):
    run(tmp_path / "flat", "build", people / "fit_0", people / "fit_1")
    told = "holds no shape_model.npz", "photograph.json"
    refused(out, told, "fit-image", photographs[2], "--model", tmp_path / "flat")


def test_finetune_writes_a_model_that_is_not_worse(model, photographs, out, tmp_path):
    figures = figures_of(out, "finetune", model, photographs[0], "--held-out", photographs[1])
    assert figures["held_out_after"] <= figures["held_out_before"]
    assert {"reflectance_model.npz", "mean.npz", "shape_model.npz", "trace.csv"} <= files_in(out)
    succeeded(run(tmp_path / "samples", "sample", out, "--count", "1"))


def test_finetune_refuses_one_photograph_for_both(model, photographs, out):
    file = photographs[0]
    for held_out in (file, file.parent / ".." / file.parent.name / file.name):
        refused(out, ["held out and tuned with"], "finetune", model, file, "--held-out", held_out)
    refused(out, ["0 held out"], "finetune", model, file)


def test_demo_compares_with_the_truth(out):
    figures = figures_of(out, "demo", "--people", "3", "--photographs", "2")
    assert max(figures["diffuse_median_error"]) < 0.04
    assert max(figures["held_out_error"]) < 0.1
    assert figures["mesh_known_error"] < 0.2
    assert figures["tuning_after"] <= figures["tuning_before"]
    for name in ("olat", "model", "samples", "fit_image/mesh", "fit_image/landmarks", "tuned"):
        assert (out / name / "reflectance.json").is_file()


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ("fit {people}/capture_0/capture.json --loss huber", "loss is 'huber'"),
        ("fit {people}/capture_0/capture.json --held-out-every 1", "held-out"),
        ("fit {people}/capture_0/capture.json --budget -1", "a number > 0"),
        ("build {people}/fit_0 --least-support 0", "least-support"),
        ("build {people}/fit_0 --synthetic 12", "either samples or --synthetic"),
        ("sample {people}/fit_0 --count 0", "count"),
    ],
)
def test_wrong_options_are_usage_errors(people, out, arguments, told):
    assert told in usage_error(run(out, *arguments.format(people=people).split()))
    assert not out.exists()


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ("olat {people}/none.json", "none.json"),
        ("fit {people}/fit_0/reflectance.json", "flash_capture.schema.json"),
        ("build {people}/capture_0", "neither"),
        ("build {people}/fit_0/overview.png", "overview.png"),
        ("sample {people}/fit_0", "reflectance_model.npz"),
        ("sample {people}/fit_0/reflectance.npz", "is not a folder"),
    ],
)
def test_wrong_files_are_named_and_leave_nothing(people, out, arguments, told):
    refused(out, [told], *arguments.format(people=people).split())


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("[1, 2]", "(2,), expected int (68,)"),
        ("{", "cannot be read"),
        (str(list(range(10**6, 10**6 + 68))), "has 3663"),
    ],
)
def test_landmark_vertices_that_do_not_fit_are_refused(people, out, tmp_path, content, told):
    (tmp_path / "marks.json").write_text(content)
    marks = ("--landmark-vertices", tmp_path / "marks.json")
    refused(out, [told, "marks.json"], "build", people / "fit_0", people / "fit_1", *marks)


def test_faces_of_other_topology_make_no_model(people, tmp_path):
    other = read_reflectance(people / "fit_1" / "reflectance.npz")
    write_reflectance(tmp_path / "other.npz", dataclasses.replace(other, faces=other.faces[:-1]))
    with pytest.raises(ReflectanceError, match=r"other\.npz has other triangles"):
        build_model([people / "fit_0", tmp_path / "other.npz"])


def spoiled(file, folder, change):
    """Return the path of a file in a copy of its folder, changed."""
    shutil.copytree(file.parent, folder)
    content = read_json(file)
    change(content, folder)
    (folder / file.name).write_text(json.dumps(content))
    return folder / file.name


def overexpose(numbers):
    def change(content, folder):
        for number in numbers:
            name = f"white_{number}.png"
            cv2.imwrite(str(folder / name), np.full((96, 96, 3), 255, np.uint8))
            content["pictures"][number]["flash_image"] = name

    return change


def test_overexposed_pairs_do_not_judge_a_fit(people, out, tmp_path):
    # The one that would be held out.
    file = spoiled(people / "capture_0" / "capture.json", tmp_path / "spoiled", overexpose([5]))
    done = run(out, "fit", file, "--json")
    figures = printed(done)
    assert figures["held_out"]["relative_rmse"] < 0.3
    assert (figures["pairs"], figures["pairs_of_capture"]) == (11, 12)
    assert "from 11 pairs, 1 left out" in done.stderr


def unlit(content, folder):
    for pair in content["pictures"]:
        pair["flash_image"] = pair["room_image"]


@pytest.mark.parametrize(
    ("command", "change", "told"),
    [
        ("fit", overexpose(range(12)), "saturated"),
        ("fit", unlit, "did the flashes fire"),
        ("olat", unlit, "did the flashes fire"),
        ("fit", lambda content, _: content["pictures"].append(content["pictures"][0]), "listed twice"),
    ],
)
def test_captures_that_show_nothing_or_one_pair_twice_are_refused(
    people, out, tmp_path, command, change, told
):
    file = spoiled(people / "capture_0" / "capture.json", tmp_path / "spoiled", change)
    refused(out, [told, "capture.json"], command, file)


def test_a_result_is_not_written_over_its_input(people, model):
    done = run(people / "fit_0" / ".." / "model", "sample", model)
    assert "is where the command reads from" in str(done.exception)
    assert record_of(model).command == "build"


def test_a_file_in_the_place_of_the_demos_input_stays(tmp_path):
    file = tmp_path / "captures" / "person_00" / "capture.json"
    file.parent.mkdir(parents=True)
    file.write_text("mine")
    done = run(tmp_path, "demo")
    assert "holds capture.json, which no run of scan2albedo reflectance" in str(done.exception)
    assert [path.read_text() for path in tmp_path.rglob("*") if path.is_file()] == ["mine"]


def _shuffled_mesh(photograph, folder):
    """Return a copy of a photograph file whose mesh has its vertices in another order."""
    shutil.copytree(photograph.parent, folder)
    mesh = trimesh.load(folder / "face.ply", process=False)
    order = np.random.default_rng(0).permutation(len(mesh.vertices))
    faces = np.argsort(order)[mesh.faces]
    trimesh.Trimesh(mesh.vertices[order], faces, process=False).export(folder / "face.ply")
    return folder / "photograph.json"


def test_a_mesh_of_other_triangles_is_refused_by_a_model_of_other_surfaces(model, photographs, tmp_path):
    file = _shuffled_mesh(photographs[0], tmp_path / "other")
    models = read_model_folder(model)
    other = dataclasses.replace(models.mean, faces=models.mean.faces[::-1])
    with pytest.raises(
        ReflectanceError, match=r"face\.ply has \d+ vertices and other triangles than the model"
    ):
        corresponding(read_photograph(file), dataclasses.replace(models, mean=other))


def test_any_mesh_of_a_face_is_brought_to_the_default_model(photographs, tmp_path):
    found = []
    for given in (photographs[0], _shuffled_mesh(photographs[0], tmp_path / "other")):
        out = tmp_path / f"of_{given.parent.name}"
        assert "geometry" not in figures_of(out, "fit-image", given)
        found.append(read_reflectance(out / "reflectance.npz").vertices)
    assert np.median(np.linalg.norm(found[0] - found[1], axis=1)) < 1.5


def test_flipped_bits_are_damage_and_no_traceback(people, tmp_path):
    data = np.fromfile(people / "fit_0" / "reflectance.npz", np.uint8)
    rng, file = np.random.default_rng(0), tmp_path / "flipped.npz"
    for place in rng.integers(0, 400, 150):
        damaged = data.copy()
        damaged[place] ^= 1 << rng.integers(8)
        damaged.tofile(file)
        # Some bits do not matter; nothing but this error may come of the others.
        with suppress(ReflectanceError):
            read_reflectance(file)


def test_an_early_end_is_noted(people, out):
    succeeded(run(out, "fit", people / "capture_0" / "capture.json", "--budget", "1e-9"))
    record = record_of(out)
    assert "stopped before it had converged" in record.notes[0]
    assert record.options["budget"] == 1e-9
