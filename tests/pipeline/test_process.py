"""The whole pipeline on a synthetic scan: results, plan, trace, budget, files."""

import csv
import json
from dataclasses import fields, replace
from itertools import pairwise

import igl
import numpy as np
import pytest
import trimesh
from helpers.meshes import write_ball
from helpers.records import files_in, read_json, valid_record
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

import scan2albedo as s2a
from scan2albedo.applications import load_result, reflectance_of_processed
from scan2albedo.applications.face_reflectance import sampled_at_vertices
from scan2albedo.core.plan import Plan, PlanStep
from scan2albedo.errors import ModelError, OutputError, RegistrationError, ScanError
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.rigid import invert_rigid, transform_points
from scan2albedo.io.images import read_image_linear
from scan2albedo.io.input_hash import input_sha256
from scan2albedo.io.obj import write_obj
from scan2albedo.io.units import MM_PER_UNIT
from scan2albedo.pipeline import stages
from scan2albedo.pipeline.demo import compare_with_truth, run_demo
from scan2albedo.pipeline.options import ProcessChanges, ProcessOptions
from scan2albedo.pipeline.quality import STEPS
from scan2albedo.registration.register import refined_registration
from scan2albedo.unlit.engine_maps import CARRIERS
from scan2albedo.unlit.light_removal import REACHES

SIZE = 128
STEP = "register.depth_annealing"
SHADOWS = "albedo.shadows"
FILES = {
    *("result.json", "geometry_image.npz", "geometry_image.exr", "albedo.exr", "albedo.png"),
    *("expected_error.exr", "shading.exr", "specular.exr", "shadow.png", "skin.png", "labels.png"),
    *("fitted.glb", "registration.json", "landmarks.json", "landmarks.csv", "trace.csv"),
    *("error_vs_time.png", "overview.png"),
}


QUICK = {"size": 64, "quality": "draft", "skip": ["albedo"]}


@pytest.fixture(scope="module")
def result(coarse_scan, tmp_path_factory):
    return s2a.process(coarse_scan[0], tmp_path_factory.mktemp("out"), size=SIZE)


@pytest.mark.slow
def test_a_scan_turned_inside_out_is_turned_back_with_a_note(coarse_scan, result):
    """The same pose and picture as of the scan as it should be, and left and right are not swapped."""
    turned = s2a.process(coarse_scan[0].inside_out(), size=SIZE, skip=["albedo"])
    assert np.array_equal(turned.scan.faces, coarse_scan[0].faces)
    assert np.array_equal(turned.registration.model_from_scan, result.registration.model_from_scan)
    assert np.array_equal(turned.geometry_image.texture_linear, result.geometry_image.texture_linear)
    assert any("inside out" in note and "mirrored" in note for note in turned.scan.notes)


def test_error_against_the_truth(result, coarse_scan):
    report = compare_with_truth(result, coarse_scan[1])
    assert report.surface_mm < 0.2
    assert report.landmarks_mm < 2.5
    assert report.lights_found >= report.lights_true
    assert report.light_deg < 5
    assert report.albedo.mse_percent < 0.2
    assert report.albedo.mse_percent < 0.25 * report.texture.mse_percent
    assert "51 inner landmarks" in report.table()
    json.dumps(report.figures())


def test_the_skin_becomes_a_reflectance_of_the_models_vertices(result, coarse_scan):
    found = reflectance_of_processed(result.out)
    assert_array_equal(found.mesh.faces, result.fitted.faces)
    known = found.reflectance.known
    assert known.mean() > 0.7
    _, truth = coarse_scan
    as_true = replace(load_result(result.out), image=truth.image)
    b = sampled_at_vertices(truth.albedo_linear.astype(float), as_true)[0][known]
    a = found.reflectance.diffuse_linear[known]
    scale = np.sum(a * b) / np.sum(a * a)
    # Of correspondence, light, and edges between 128 x 128 texels together.
    assert np.linalg.norm(scale * a - b) < 0.12 * np.linalg.norm(b)


def test_files_of_the_contract_keep_to_their_schemas_and_none_else_is_there(result):
    assert files_in(result.out) == FILES
    assert files_in(result.out.parent) == {result.out.name}
    names = ("result", "registration", "landmarks")
    written, poses, _ = (valid_record(result.out / f"{name}.json", name) for name in names)
    assert set(written["files"]) == FILES
    assert_array_equal(poses["model_from_scan"], result.registration.model_from_scan)
    assert_array_equal(poses["fitted_from_scan"], poses["model_from_scan"])


def test_landmarks_lie_on_the_scan_in_the_unit_of_its_file(result, tmp_path):
    table = np.genfromtxt(result.out / "landmarks.csv", delimiter=",", names=True, dtype=None)
    on_scan = np.stack([table[f"scan_{axis}"] for axis in "xyz"], 1)
    assert_allclose(on_scan, result.landmarks_scan, rtol=1e-6)
    written = read_json(result.out / "landmarks.json")
    assert written["mm_per_unit"] == 1
    points = {name: [point[name] for point in written["landmarks"]] for name in written["landmarks"][0]}
    assert points["number"] == list(range(68))
    assert_array_equal(points["model_mm"], result.fitted.landmarks)
    assert_array_equal(points["scan"], result.landmarks_scan)
    off = ClosestPointQuery(result.scan.vertices, result.scan.faces).query(on_scan[17:]).distance
    assert np.median(off) < 0.5
    write_obj(tmp_path / "cm.obj", result.scan.vertices / 10, result.scan.faces)
    again = s2a.process(tmp_path / "cm.obj", unit="cm", **QUICK)
    assert again.scan.mm_per_unit == 10
    plain = s2a.process(replace(result.scan, uv=None, texture_linear=None), **QUICK)
    assert np.linalg.norm(10 * again.landmarks_scan - plain.landmarks_scan, axis=1)[17:].max() < 0.5


@pytest.mark.slow
def test_landmarks_of_a_file_are_followed_in_the_scans_own_unit(coarse_scan, result, tmp_path):
    scan, _ = coarse_scan
    write_obj(tmp_path / "face.obj", scan.vertices / 1000, scan.faces)
    five = [36, 45, 30, 48, 54]
    marks = result.landmarks_scan[five] / 1000
    to_the_left = invert_rigid(result.fitted.model_from_scan)[:3, 0]
    rows = np.column_stack([five, marks + 0.003 * to_the_left])
    np.savetxt(tmp_path / "marks.csv", rows, "%d,%.17g,%.17g,%.17g", header="number,x,y,z", comments="")
    found = s2a.process(tmp_path / "face.obj", landmarks=tmp_path / "marks.csv", **QUICK)
    moved = (found.landmarks_scan[five] - marks) @ to_the_left
    assert 0.0015 < moved.mean() < 0.0035
    assert "5 landmarks given" in found.notes
    points = np.full((68, 3), np.nan)
    points[30] = marks[2] * 1000
    one, same = (s2a.process(scan, landmarks=given, **QUICK) for given in ({30: points[30]}, points))
    assert "1 landmarks given" in one.notes
    assert_array_equal(same.landmarks_scan, one.landmarks_scan)
    assert same.options["landmarks"] == "given"
    assert not same.plan.ran("fit.covers")


def test_the_registration_has_the_pose_of_the_fit_and_the_distance_there(result, coarse_scan):
    registration, model = result.registration, s2a.AnnotatedFaceModel.default()
    assert_array_equal(registration.model_from_scan, result.fitted.model_from_scan)
    assert registration.face_scale == result.fitted.metrics["scale"]
    searched = s2a.register(coarse_scan[0], model)
    apart = np.abs(registration.model_from_scan - searched.model_from_scan)
    assert 1e-6 < apart[:3, :3].max() < 0.05

    # The distance of the search's pose, measured as it is here, is that of `register`.
    again, anew = (
        refined_registration(searched, coarse_scan[0], model, at.model_from_scan, at.face_scale)
        for at in (searched, registration)
    )
    assert again.rmse_mm == pytest.approx(searched.rmse_mm, rel=1e-9)
    assert (anew.rmse_mm, anew.plan) == (registration.rmse_mm, registration.plan)
    (row,) = result.plan.of_stage("register.refined_pose")
    assert "degrees and" in row.evidence


def test_files_hold_what_the_result_holds(result):
    image = s2a.read_geometry_image(result.out / "geometry_image.npz")
    assert_array_equal(image.position, result.geometry_image.position)
    assert_array_equal(image.region, result.geometry_image.region)
    assert_array_equal(read_image_linear(result.out / "albedo.exr"), result.albedo.albedo_linear)
    with Image.open(result.out / "albedo.png") as preview:
        assert_array_equal(preview.getchannel("A"), 255 * image.seen)
    rows = csv.DictReader((result.out / "trace.csv").read_text().splitlines())
    assert [row["stage"] for row in rows] == [row.stage for row in result.trace.rows]


def test_a_hole_where_the_nose_should_be_and_half_a_face_are_told(coarse_scan, result):
    """And of the whole face nothing is told."""
    assert not any("no scan near" in note or "proportions" in note for note in result.notes)
    scan, truth = coarse_scan
    placed = transform_points(truth.model_from_scan, scan.vertices)
    nose = np.linalg.norm(placed - truth.landmarks[30], axis=1) < 25
    holed, half = (
        s2a.process(scan.without_faces(lost[scan.faces].any(1)), **QUICK)
        for lost in (nose, placed[:, 0] <= -8)
    )
    assert any("no scan near the nose" in note for note in holed.notes)
    assert half.fitted.metrics["coverage"] < 0.8
    assert sum("% of the face has scan near it" in note for note in half.notes) == 1


def test_the_plan_tells_what_ran_and_why(result):
    assert all(map(result.plan.ran, ("register", "fit", "geometry_image", "albedo")))
    assert all(step.reason for step in result.plan)
    assert any(not step.ran and step.evidence for step in result.plan)


def test_every_iterative_stage_leaves_a_trace_that_ends_no_worse_than_it_began(result):
    assert {"icp", "fit", "albedo"} <= set(result.trace.stages)
    for stage in result.trace.stages:
        rows = result.trace.of_stage(stage).rows
        assert rows[-1].error <= rows[0].error, stage
        assert all(a.elapsed_s <= b.elapsed_s for a, b in pairwise(rows))
        assert all(a.evaluations <= b.evaluations for a, b in pairwise(rows))


def test_what_is_doubtful_is_told(coarse_scan, result, monkeypatch):
    """A doubtful pose and a lamp of unknown strength; nothing about a clear scan."""
    assert result.notes == (*coarse_scan[0].notes, *(step.text for step in result.plan.doubts()))
    assert not any("unsure" in note or "known to" in note for note in result.notes)
    assert "pose unsure" not in result.summary()

    def doubtful(*arguments, **options):
        return replace(result.registration, confidence=0.21)

    def dim(*arguments, **options):
        uncertainty = replace(result.albedo.uncertainty, intensity=(0.364,))
        return replace(result.albedo, uncertainty=uncertainty)

    monkeypatch.setattr(stages, "register", doubtful)
    monkeypatch.setattr(stages, "estimate_albedo", dim)
    told = s2a.process(coarse_scan[0], size=64, budget=s2a.Budget(evaluations=20))
    assert any("pose is unsure (confidence 0.21)" in note for note in told.notes)
    assert any("strength is known to 36 %" in note for note in told.notes)
    assert "pose unsure (confidence 0.21)" in told.summary()
    assert "texture" not in told.summary()
    flipped = replace(told, plan=told.plan + Plan((PlanStep.doubt("texture", "with V flipped"),)))
    assert "texture doubtful" in flipped.summary()
    lost = replace(result.scan, notes=("unit: mm", "texture a.jpg is missing: went on without it"))
    bare = replace(result, albedo=None, scan=lost).summary()
    assert bare.split("; ")[1] == "no albedo: texture a.jpg is missing: went on without it"
    assert "no albedo: see the plan" in replace(result, albedo=None).summary()
    error = result.albedo.expected_error[result.geometry_image.mask]
    assert np.mean(error <= result.metrics()["albedo"]["expected_error"]) == pytest.approx(0.5, abs=0.01)


@pytest.mark.slow
def test_same_input_and_seed_give_the_same_bits(coarse_scan, result):
    again = s2a.process(coarse_scan[0], size=SIZE)
    assert_array_equal(again.registration.model_from_scan, result.registration.model_from_scan)
    assert_array_equal(again.fitted.vertices, result.fitted.vertices)
    assert_array_equal(again.albedo.albedo_linear, result.albedo.albedo_linear)


def test_a_budget_gives_the_best_answer_so_far(coarse_scan):
    hurried = s2a.process(coarse_scan[0], size=64, budget=s2a.Budget(evaluations=20))
    assert not hurried.albedo.converged
    assert "not converged: " in hurried.summary()
    assert np.isfinite(hurried.albedo.albedo_linear).all()


def test_skipped_stages_cost_nothing_and_are_said(coarse_scan):
    result = s2a.process(coarse_scan[0], **QUICK | {"skip": ["albedo", STEP]})
    assert result.albedo is None
    assert "albedo" not in result.trace.stages
    assert "depth_annealing" not in result.trace.stages
    assert [(s.ran, s.reason) for s in result.plan.of_stage("albedo")] == [(False, "skipped by the caller")]


@pytest.mark.slow
def test_a_scan_without_colour_ends_without_albedo_and_says_so(coarse_scan, tmp_path):
    plain = replace(coarse_scan[0], uv=None, texture_linear=None)
    result = s2a.process(plain, tmp_path, size=64)
    assert result.albedo is None
    assert "no usable colour" in result.plan.of_stage("albedo")[0].reason
    names = files_in(result.out)
    assert "albedo.png" not in names
    assert {"overview.png", "geometry_image.npz", "result.json"} <= names


@pytest.fixture(scope="module")
def ball():
    """A lit sphere: an object, no face."""
    mesh = trimesh.creation.icosphere(3, 60.0)
    shade = np.clip(mesh.vertex_normals @ [0.5, 0.3, 0.8], 0, None)[:, None] * [0.5, 0.4, 0.3] + 0.1
    return s2a.RawScan(mesh.vertices, mesh.faces, vertex_color_linear=shade, name="ball")


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"skip": ["nonsense"]}, "unknown stage"),
        ({"skip": ["fit"]}, "cannot be skipped"),
        ({"force": ["nonsense"]}, "unknown stage"),
        ({"force": ["fit"]}, f"'fit' cannot be forced.*can be forced is {STEP}, albedo.shad"),
        ({"skip": [SHADOWS], "force": [SHADOWS]}, f"is forced, but '{SHADOWS}' is skip"),
        ({"skip": ["albedo"], "force": [SHADOWS]}, "is forced, but 'albedo' is skipped"),
        ({"brdf": "phong"}, "oren-nayar"),
        ({"lights": 0}, "lights is 0"),
        ({"lights": 1.5}, "lights is 1.5"),
        ({"lights": 99}, "lights is 99"),
        ({"unit": "yard"}, "unit is 'yard', expected one of auto, mm"),
        ({"size": 2}, "from 8 to 16384"),
        ({"size": 64.5}, "size is 64.5"),
        ({"size": 10**9}, "from 8 to 16384"),
        ({"texture_size": 9000}, "texture_size is 9000"),
        ({"unlit": "head"}, "unlit is 'head'"),
        ({"files": "few"}, "files is 'few'"),
    ],
)
def test_unknown_names_and_impossible_wishes_are_refused_before_any_work(wrong, message):
    with pytest.raises(ValueError, match=message):
        s2a.process("nobody.obj", **wrong)


@pytest.mark.parametrize(
    ("choice", "evaluations", "forced"),
    [({}, 400, False), ({"skip": [STEP]}, 0, False), ({"force": [STEP]}, 400, True)],
)
def test_annealing_is_skipped_or_forced_as_asked(ball, monkeypatch, choice, evaluations, forced):
    given = []

    def register(*arguments, options, **keywords):
        given.append(options)
        raise RegistrationError("far enough")

    monkeypatch.setattr(stages, "register", register)
    with pytest.raises(RegistrationError, match="far enough"):
        s2a.process(ball, **choice)
    assert [(o.annealing_evaluations, o.force_annealing) for o in given] == [(evaluations, forced)]


def test_an_object_without_a_face_goes_through_xatlas_charts_and_forced_steps_run(ball, tmp_path):
    # Nothing is saturated, so there is nothing to inpaint; the parts of the light are always in the model.
    asked = {"model": "none", "size": 32, "lights": 1}
    result = s2a.process(ball, tmp_path, **asked)
    assert result.registration is result.fitted is None
    assert result.albedo is not None
    assert (result.out / "overview.png").is_file()
    assert not result.plan.ran("register")
    assert not result.plan.ran(SHADOWS)
    assert {step.stage for step in result.plan} > {name for name in STEPS if name.startswith("albedo.")}
    forced = s2a.process(ball, **asked, force=[SHADOWS])
    assert forced.plan.ran(SHADOWS)
    assert forced.options["force"] == [SHADOWS]


def test_an_error_carries_the_doubts_of_earlier_stages(ball, monkeypatch):
    def fail(*arguments):
        raise ScanError("no soup")

    monkeypatch.setattr(stages, "geometry_image_of_scan", fail)
    with pytest.raises(ScanError, match="no soup") as caught:
        s2a.process(ball, model="none", size=48, landmarks={30: (0, 0, 60)})
    assert caught.value.__notes__ == ["landmarks are not used: without a model nothing is fitted to them"]


def test_the_input_is_hashed_as_it_was_read(tmp_path, monkeypatch):
    scan = write_ball(tmp_path / "ball.ply", radius=60.0)
    before = input_sha256(scan)
    sample = stages.geometry_image_of_scan

    def edit_and_sample(*arguments):
        scan.write_bytes(scan.read_bytes() + b"\n")
        return sample(*arguments)

    monkeypatch.setattr(stages, "geometry_image_of_scan", edit_and_sample)
    skipped = {"model": "none", "size": 48, "pictures": False, "skip": ["albedo"]}
    result = s2a.process(scan, tmp_path / "out", **skipped)
    record = read_json(result.out / "result.json")
    assert record["input"]["sha256"] == result.input_sha256 == before != input_sha256(scan)


def test_missing_files_and_what_is_no_face_are_named(coarse_scan, ball, tmp_path):
    (tmp_path / "file").touch()
    for source, options, error, words in (
        ("nowhere.obj", {}, ScanError, r"nowhere\.obj"),
        (ball, {"model": "nowhere.json"}, ModelError, r"nowhere\.json"),
        (ball, {"model": "default", "out": tmp_path}, RegistrationError, "ball"),
        (coarse_scan[0], {"out": tmp_path / "file" / "out"}, OutputError, "file"),
    ):
        with pytest.raises(error, match=words):
            s2a.process(source, **options)
    assert files_in(tmp_path) == {"file"}


def test_its_keywords_are_its_options_and_win_over_them(ball):
    assert ProcessChanges.__annotations__.keys() == {option.name for option in fields(ProcessOptions)}
    tiny = ProcessOptions(model="none", size=64, skip=["albedo"])
    result = s2a.process(ball, None, tiny, size=32)
    assert result.geometry_image.shape == (32, 32)
    assert result.options["skip"] == ["albedo"]


def test_choices_of_options_are_those_of_the_stages():
    choices = {option.name: option.metadata["choices"] for option in fields(ProcessOptions)}
    assert choices["unit"] == ("auto", *MM_PER_UNIT)
    assert choices["unlit"] == (None, *REACHES)
    assert choices["maps"] == (None, *CARRIERS)


@pytest.mark.parametrize(
    ("wrong", "hint"),
    [
        ("sise", "process\\(\\) has no option 'sise': did you mean 'size'\\?"),
        ("onprogress", "did you mean 'on_progress'"),
        ("xyz", "has no option 'xyz'; options are name, on_progress, model, "),
    ],
)
def test_an_unknown_option_is_named_with_the_one_that_is_meant(wrong, hint):
    with pytest.raises(TypeError, match=hint):
        s2a.process("nobody.obj", **{wrong: 64})


@pytest.mark.slow
def test_demo_at_full_size():
    report = run_demo(None)
    assert report.surface_mm < 0.2
    assert report.landmarks_mm < 2.0
    # Its weak highlight stays in the albedo.
    assert report.albedo.mse_percent < 0.042
    assert report.light_deg < 4


@pytest.mark.slow
def test_a_template_of_ones_own_comes_back_in_its_own_topology(coarse_scan, tmp_path):
    """A control mesh turned and in metres as template: as many vertices, in the same order."""
    own = s2a.AnnotatedFaceModel.default()
    turn = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    template = tmp_path / "mine.obj"
    igl.writeOBJ(str(template), own.control_vertices @ turn.T / 1000, own.control_faces)
    result = s2a.process(coarse_scan[0], tmp_path, model=template, size=64, skip=["albedo"])
    vertices, faces = igl.read_triangle_mesh(str(result.out / "template.obj"))
    assert_allclose(vertices, result.fitted.template_vertices, atol=1e-3)
    assert_array_equal(faces, own.control_faces)
    truth = coarse_scan[1]
    truth_from_fit = truth.model_from_scan @ invert_rigid(result.fitted.model_from_scan)
    landmarks = transform_points(truth_from_fit, result.fitted.landmarks)
    assert np.linalg.norm(landmarks - truth.landmarks, axis=1)[17:].mean() < 3
