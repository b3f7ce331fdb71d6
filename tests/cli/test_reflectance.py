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
from worlds.environments import generated_environment

from scan2albedo.errors import ReflectanceError
from scan2albedo.io.records import read_record
from scan2albedo.reflectance import (
    MorphableReflectanceModel,
    read_photograph,
    read_reflectance,
)
from scan2albedo.runs.reflectance import ReflectanceRecord
from scan2albedo.runs.reflectance.demo import write_synthetic_capture, write_synthetic_photograph
from scan2albedo.runs.reflectance.image_run import corresponding
from scan2albedo.runs.reflectance.model_run import read_model_folder
from scan2albedo.synthetic import (
    Portrait,
    face_photograph,
    flash_capture,
)

pytestmark = pytest.mark.slow

SMALL = Portrait(picture_size=96)


def run(*arguments):
    return invoke("reflectance", *arguments)


@pytest.fixture(scope="module")
def captures():
    return [flash_capture(seed, views=3, flashes=4, levels=1, portrait=SMALL) for seed in (0, 1)]


@pytest.fixture(scope="module")
def people(captures, tmp_path_factory):
    """Folder with captures and fits of two people."""
    folder = tmp_path_factory.mktemp("people")
    for seed, capture in enumerate(captures):
        write_synthetic_capture(capture, folder / f"capture_{seed}")
        succeeded(run("fit", folder / f"capture_{seed}" / "capture.json", "-o", folder / f"fit_{seed}"))
    return folder


def test_olat_writes_a_linear_picture_a_pair(people, tmp_path):
    figures = printed(run("olat", people / "capture_0" / "capture.json", "-o", tmp_path / "olat", "--json"))
    assert figures["pairs"] == 12
    assert len(list((tmp_path / "olat").glob("olat_*.exr"))) == 12
    record = read_record(tmp_path / "olat" / "reflectance.json", ReflectanceRecord)
    assert set(record.files) == files_in(tmp_path / "olat")


def test_fit_writes_what_its_record_says(people):
    folder = people / "fit_0"
    record = read_record(folder / "reflectance.json", ReflectanceRecord)
    assert set(record.files) == files_in(folder)
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
    done = succeeded(
        run("build", people / "fit_0", people / "fit_1" / "reflectance.npz", "-o", model_folder, "--json")
    )
    assert json.loads(done.stdout)["components"] == 1
    model = MorphableReflectanceModel.load(model_folder / "reflectance_model.npz")
    assert model.samples == 2
    for out in ("a", "b"):
        done = succeeded(run("sample", model_folder, "-o", tmp_path / out, "--count", 2, "--seed", 5))
    files = sorted(files_in(tmp_path / "a"))
    assert files == ["reflectance.json", "sample_000.npz", "sample_001.npz", "samples.png"]
    one, again = (read_reflectance(tmp_path / out / "sample_001.npz") for out in ("a", "b"))
    assert np.array_equal(one.reflectance.weights, again.reflectance.weights, equal_nan=True)


@pytest.fixture(scope="module")
def model(people, captures):
    """Folder of a model of two people, with shapes."""
    capture = captures[0]
    distance = np.linalg.norm(capture.landmarks[:, None] - capture.vertices[None], axis=2)
    (people / "landmarks.json").write_text(json.dumps(distance.argmin(1).tolist()))
    fits = (people / "fit_0", people / "fit_1")
    landmarks = ("--landmark-vertices", people / "landmarks.json")
    succeeded(run("build", *fits, "-o", people / "model", *landmarks))
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


def test_fit_image_with_a_mesh(model, photographs, tmp_path):
    figures = printed(run("fit-image", photographs[0], "--model", model, "-o", tmp_path / "out", "--json"))
    assert 0 < figures["relative_rmse"] < 0.4
    assert len(figures["light_harmonics"]) == 81
    assert "geometry" not in figures
    record = read_record(tmp_path / "out" / "reflectance.json", ReflectanceRecord)
    assert set(record.files) == files_in(tmp_path / "out")
    assert read_reflectance(tmp_path / "out" / "reflectance.npz").reflectance.known.any()


def test_fit_image_from_landmarks(model, photographs, tmp_path):
    done = succeeded(run("fit-image", photographs[2], "--model", model, "-o", tmp_path / "out", "--json"))
    geometry = json.loads(done.stdout)["geometry"]
    assert 0 < geometry["landmark_rmse_px"] < 8
    trace = (tmp_path / "out" / "trace.csv").read_text()
    assert "reflectance.geometry.landmarks" in trace
    assert "reflectance.image" in trace


def test_fit_image_without_a_model_takes_the_default_one_and_says_what_it_believes(photographs, tmp_path):
    figures = printed(run("fit-image", photographs[2], "-o", tmp_path / "out", "--json"))
    assert [step["stage"].split(".")[-1] for step in figures["plan"]] == ["details", "person", "hue"]
    assert figures["beats_mean"] == any(step["ran"] for step in figures["plan"])
    record = read_record(tmp_path / "out" / "reflectance.json", ReflectanceRecord)
    assert record.inputs == (str(photographs[2]),)
    assert figures["beats_mean"] != any("mean face" in note for note in record.notes)


def test_build_from_synthetic_people(tmp_path):
    done = succeeded(run("build", "--synthetic", 12, "-o", tmp_path / "model", "--json"))
    assert json.loads(done.stdout)["samples"] == 12
    assert (tmp_path / "model" / "shape_model.npz").is_file()
    refused = run("build", "--synthetic", 12, tmp_path / "model", "-o", tmp_path / "other")
    assert "either samples or --synthetic" in refused.output


def test_a_photograph_without_gamma_is_told(model, photographs, tmp_path):
    shutil.copytree(photographs[0].parent, tmp_path / "raw")
    file = tmp_path / "raw" / "photograph.json"
    given = read_json(file)
    given.pop("gamma")
    file.write_text(json.dumps(given))
    succeeded(run("fit-image", file, "--model", model, "--budget", "1", "-o", tmp_path / "out"))
    succeeded(
        run("finetune", model, file, "--held-out", photographs[1], "--budget", "1", "-o", tmp_path / "tuned")
    )
    for out in ("out", "tuned"):
        record = read_record(tmp_path / out / "reflectance.json", ReflectanceRecord)
        assert sum("photograph.json gives no gamma" in note for note in record.notes) == 1


def test_landmarks_without_a_shape_model_are_refused(people, model, photographs, tmp_path):
    run("build", people / "fit_0", people / "fit_1", "-o", tmp_path / "flat")
    done = run("fit-image", photographs[2], "--model", tmp_path / "flat", "-o", tmp_path / "out")
    assert "holds no shape_model.npz" in str(done.exception)
    assert "photograph.json" in str(done.exception)
    assert not (tmp_path / "out").exists()


def test_finetune_writes_a_model_that_is_not_worse(model, photographs, tmp_path):
    figures = printed(
        run("finetune", model, photographs[0], "--held-out", photographs[1], "-o", tmp_path / "out", "--json")
    )
    assert figures["held_out_after"] <= figures["held_out_before"]
    files = files_in(tmp_path / "out")
    assert {"reflectance_model.npz", "mean.npz", "shape_model.npz", "trace.csv"} <= files
    succeeded(run("sample", tmp_path / "out", "-o", tmp_path / "samples", "--count", "1"))


def test_finetune_refuses_one_photograph_for_both(model, photographs, tmp_path):
    both = run("finetune", model, photographs[0], "--held-out", photographs[0], "-o", tmp_path / "out")
    assert "held out and tuned with" in str(both.exception)
    few = run("finetune", model, photographs[0], "-o", tmp_path / "out")
    assert "0 held out" in str(few.exception)


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("[1, 2]", "(2,), expected int (68,)"),
        ("{", "cannot be read"),
        (json.dumps(list(range(10**6, 10**6 + 68))), "has 3663"),
    ],
)
def test_landmark_vertices_that_do_not_fit_are_refused(people, tmp_path, content, told):
    (tmp_path / "marks.json").write_text(content)
    marks = ("--landmark-vertices", tmp_path / "marks.json")
    done = run("build", people / "fit_0", people / "fit_1", "-o", tmp_path / "out", *marks)
    assert told in str(done.exception)
    assert "marks.json" in str(done.exception)


def test_demo_compares_with_the_truth(tmp_path):
    figures = printed(run("demo", "-o", tmp_path / "out", "--people", "3", "--photographs", "2", "--json"))
    assert max(figures["diffuse_median_error"]) < 0.04
    assert max(figures["held_out_error"]) < 0.1
    assert figures["mesh_known_error"] < 0.2
    assert figures["tuning_after"] <= figures["tuning_before"]
    for name in ("olat", "model", "samples", "fit_image/mesh", "fit_image/landmarks", "tuned"):
        assert (tmp_path / "out" / name / "reflectance.json").is_file()


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("fit", "{people}/capture_0/capture.json", "-o", "{out}", "--loss", "huber"), "loss is 'huber'"),
        (("fit", "{people}/capture_0/capture.json", "-o", "{out}", "--held-out-every", "1"), "held-out"),
        (("fit", "{people}/capture_0/capture.json", "-o", "{out}", "--budget", "-1"), "a number > 0"),
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
        (("sample", "{people}/fit_0/reflectance.npz", "-o", "{out}"), "is not a folder"),
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
    from scan2albedo.runs.reflectance.model_run import build_model

    known = np.ones(len(other.vertices), bool)
    one = VertexReflectance(other.diffuse_linear, other.weights, known)
    write_reflectance(tmp_path / "other.npz", MeshReflectance(other.vertices, other.faces[:-1], one))
    with pytest.raises(ReflectanceError, match=r"other\.npz has other triangles"):
        build_model([people / "fit_0", tmp_path / "other.npz"])


def spoiled(people, tmp_path, change):
    """Path of a copy of capture 0 whose file is changed."""
    shutil.copytree(people / "capture_0", tmp_path / "spoiled")
    file = tmp_path / "spoiled" / "capture.json"
    content = read_json(file)
    change(content, file.parent)
    file.write_text(json.dumps(content))
    return file


def overexpose(numbers):
    def change(content, folder):
        for number in numbers:
            name = f"white_{number}.png"
            cv2.imwrite(str(folder / name), np.full((96, 96, 3), 255, np.uint8))
            content["pictures"][number]["flash_image"] = name

    return change


def test_overexposed_pairs_do_not_judge_a_fit(people, tmp_path):
    file = spoiled(people, tmp_path, overexpose([5]))  # the one that would be held out
    done = succeeded(run("fit", file, "-o", tmp_path / "out", "--json"))
    figures = json.loads(done.stdout)
    assert figures["held_out"]["relative_rmse"] < 0.3
    assert (figures["pairs"], figures["pairs_of_capture"]) == (11, 12)
    assert "from 11 pairs, 1 left out" in done.stderr


def test_saturation_everywhere_is_told(people, tmp_path):
    done = run("fit", spoiled(people, tmp_path, overexpose(range(12))), "-o", tmp_path / "out")
    assert "capture.json" in str(done.exception)
    assert "saturated" in str(done.exception)
    assert not (tmp_path / "out").exists()


def test_flashes_that_did_not_fire_are_told(people, tmp_path):
    def change(content, folder):
        for pair in content["pictures"]:
            pair["flash_image"] = pair["room_image"]
        kept = {}
        for pair in content["pictures"]:
            kept[pair["camera"], pair["flash"]] = pair
        content["pictures"] = list(kept.values())

    for command in ("fit", "olat"):
        file = spoiled(people, tmp_path / command, change)
        done = run(command, file, "-o", tmp_path / "out")
        assert "did the flashes fire" in str(done.exception)
        assert "capture.json" in str(done.exception)
        assert not (tmp_path / "out").exists()


def test_one_pair_listed_twice_is_refused(people, tmp_path):
    file = spoiled(people, tmp_path, lambda c, _: c["pictures"].append(c["pictures"][0]))
    assert "listed twice" in str(run("fit", file, "-o", tmp_path / "out").exception)


def test_a_result_is_not_written_over_its_input(people, model):
    done = run("sample", model, "-o", people / "fit_0" / ".." / "model")
    assert "is where the command reads from" in str(done.exception)
    assert read_record(model / "reflectance.json", ReflectanceRecord).command == "build"


def test_a_file_in_the_place_of_the_demos_input_stays(tmp_path):
    file = tmp_path / "captures" / "person_00" / "capture.json"
    file.parent.mkdir(parents=True)
    file.write_text("mine")
    done = run("demo", "-o", tmp_path)
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
    file = _shuffled_mesh(photographs[0], tmp_path / "other")
    found = {}
    for name, given in {"any": file, "own": photographs[0]}.items():
        done = succeeded(run("fit-image", given, "-o", tmp_path / name, "--json"))
        found[name] = read_reflectance(tmp_path / name / "reflectance.npz")
        assert "geometry" not in json.loads(done.stdout)
    off = np.linalg.norm(found["any"].vertices - found["own"].vertices, axis=1)
    assert np.median(off) < 1.5


def test_the_same_photograph_by_another_path_is_found_out(model, photographs, tmp_path):
    again = photographs[0].parent / ".." / photographs[0].parent.name / photographs[0].name
    done = run("finetune", model, photographs[0], "--held-out", again, "-o", tmp_path / "out")
    assert "held out and tuned with" in str(done.exception)


def test_flipped_bits_are_damage_and_no_traceback(people, tmp_path):
    data = bytearray((people / "fit_0" / "reflectance.npz").read_bytes())
    rng, file = np.random.default_rng(0), tmp_path / "flipped.npz"
    for place in rng.integers(0, 400, 150):
        damaged = bytearray(data)
        damaged[place] ^= 1 << int(rng.integers(8))
        file.write_bytes(damaged)
        # Some bits do not matter; nothing but this error may come of the others.
        with suppress(ReflectanceError):
            read_reflectance(file)


def test_an_early_end_is_noted(people, tmp_path):
    succeeded(run("fit", people / "capture_0" / "capture.json", "-o", tmp_path / "out", "--budget", "1e-9"))
    record = read_record(tmp_path / "out" / "reflectance.json", ReflectanceRecord)
    assert "stopped before it had converged" in record.notes[0]
    assert record.options["budget"] == 1e-9
