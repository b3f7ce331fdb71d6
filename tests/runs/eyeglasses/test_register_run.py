"""Frames registered on faces from files and to files, and the command for it."""

import hashlib
import json
import re
import shutil

import numpy as np
import pytest
import trimesh
from helpers.cli import invoke
from helpers.commands import printed, refusal, succeeded
from helpers.gltf import Gltf
from helpers.npz import cut
from helpers.records import files_in, read_json, valid_record
from helpers.usage import usage_error
from helpers.wearers import small_wearer
from matplotlib.figure import Figure
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.core import Trace
from scan2albedo.errors import OutputError
from scan2albedo.eyeglasses import (
    canonicalize,
    read_cameras,
    read_keypoints,
    read_labels,
    read_registered,
    skin,
    write_canonical,
    write_keypoints,
    write_labels,
    write_start,
)
from scan2albedo.eyeglasses.mean_keypoints import front_width
from scan2albedo.geometry.rigid import compose, rotation_from_vector
from scan2albedo.io import load_scan
from scan2albedo.report.overview import Panel
from scan2albedo.runs.eyeglasses import register_run as glasses_registration_files
from scan2albedo.runs.eyeglasses.demo import write_wearer
from scan2albedo.runs.eyeglasses.inputs import read_registration
from scan2albedo.runs.eyeglasses.register_run import register_frame

pytestmark = pytest.mark.slow

FILES = {
    "registered.glb",
    "registered.npz",
    "keypoints.json",
    "result.json",
    "trace.csv",
    "error_vs_time.png",
    "overview.png",
}


@pytest.fixture(scope="module")
def person():
    return small_wearer(1, noise_px=0.3)


@pytest.fixture(scope="module")
def inputs(person, tmp_path_factory):
    """A folder with the wearer's files, and the frame once more as a canonical one that brings weights."""
    out = tmp_path_factory.mktemp("wearer")
    write_wearer(person, (person.head_vertices, person.head_faces), out)
    glasses = person.glasses
    found = canonicalize(
        [(glasses.rest_vertices, glasses.faces)],
        [glasses.rest_keypoints],
        mean_keypoints=glasses.rest_keypoints,
        spacing=3.0,
    )
    folder = out / "input" / "round"
    folder.mkdir()
    write_canonical(folder / "canonical.npz", found.frames[0])
    return out / "input"


@pytest.fixture
def undrawn(monkeypatch):
    """No pictures: drawing takes longer than all the rest."""
    panel = Panel("", np.zeros((4, 4, 3), np.uint8))
    monkeypatch.setattr(glasses_registration_files, "registration_panels", lambda *a: [panel])
    monkeypatch.setattr(Trace, "plot", lambda trace: Figure((1, 1)))


@pytest.fixture
def changed(inputs, tmp_path):
    """A copy of the files, to be spoiled."""
    return shutil.copytree(inputs, tmp_path / "changed")


def run(mesh, out, folder, *more, masks=True, head=True):
    arguments = [mesh, "-o", out, "--cameras", folder / "cameras.json", "--labels", folder / "labels.json"]
    arguments += ["--masks", folder / "masks"] if masks else []
    arguments += ["--head", folder / "head.glb"] if head else []
    return invoke("glasses", "register", *arguments, *more)


@pytest.fixture(scope="module")
def done(inputs, tmp_path_factory):
    """The frame from its mesh, through the command."""
    out = tmp_path_factory.mktemp("registered")
    return out, run(inputs / "frame.obj", out, inputs, "--json")


def test_a_measured_front_sets_the_scale_of_a_frame(inputs):
    files = (inputs / "frame.obj", inputs / "cameras.json", inputs / "labels.json")
    usual = read_registration(*files).frame
    width = front_width(usual.keypoints, usual.scan.vertices)
    larger = read_registration(*files, frame_width_mm=1.1 * width).frame
    assert_allclose(larger.keypoints, 1.1 * usual.keypoints, rtol=1e-12)
    assert_allclose(larger.scan.vertices, 1.1 * usual.scan.vertices, rtol=1e-6)
    assert larger.mm_per_unit == pytest.approx(1.1 * usual.mm_per_unit)


def test_a_frame_lands_where_the_pictures_show_it(done, person):
    out, answer = done
    succeeded(answer)
    frame = read_registered(out / "registered.npz")
    error = np.linalg.norm(frame.vertices - person.vertices, axis=1)
    # A pixel of these small pictures is 1.3 mm.
    assert np.sqrt(np.mean(error[person.seen] ** 2)) < 0.8
    assert files_in(out) == FILES
    assert "frame: placed in" in answer.stderr
    assert "head head.glb: unit: m" in answer.stderr
    rows = [line.split(",") for line in (out / "trace.csv").read_text().splitlines()[1:]]
    stages = list(dict.fromkeys(row[0] for row in rows))
    assert stages == ["glasses.pose", "glasses.key_points", "glasses.outlines"]
    for stage in stages:  # whose clocks do not go back
        mine = [(float(row[1]), int(row[3])) for row in rows if row[0] == stage]
        assert mine == sorted(mine)


def test_the_files_hold_what_was_done(done, inputs, person):
    out, answer = done
    summary, frame = printed(answer), read_registered(out / "registered.npz")
    bent = skin(person.glasses.rest_vertices, frame.weights, frame.handle_transforms)
    assert_allclose(bent, frame.vertices, atol=1e-9)
    assert_array_equal(read_keypoints(out / "keypoints.json"), frame.keypoints)
    assert_allclose(load_scan(out / "registered.glb").vertices, frame.vertices, atol=1e-4)
    nodes = {node["name"]: node for node in Gltf.read(out / "registered.glb").tree["nodes"]}
    # The tree's root stands at its key point, in metres.
    assert_allclose(nodes["bridge_top"]["translation"], frame.keypoints[0] / 1000, atol=1e-9)

    record = valid_record(out / "result.json", "registered_eyeglasses")
    assert set(record["files"]) == FILES
    assert record["name"] == "frame"
    assert_array_equal(record["world_from_glasses"], frame.world_from_glasses)
    names = [camera.name for camera in read_cameras(inputs / "cameras.json")]
    files = {"cameras": "cameras.json", "labels": "labels.json", "keypoints": "frame.keypoints.json"}
    files |= {f"mask {name}": f"masks/{name}.png" for name in names}
    assert set(record["inputs"]) == {*files, "mesh", "head"}
    for what, name in files.items():
        path = inputs / name
        assert record["inputs"][what]["file"] == str(path)
        assert record["inputs"][what]["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
    for view, name, iou in zip(record["views"], names, frame.iou, strict=True):
        assert (view["camera"], view["mask"], view["iou"]) == (name, True, iou)
    errors = frame.label_errors_px[frame.inliers]
    assert record["metrics"]["label_rms_px"] == pytest.approx(np.sqrt(np.mean(errors**2)))
    assert record["metrics"]["labels"] == np.isfinite(person.labels[:, :, 0]).sum()
    assert record["metrics"]["observed_share"] == frame.observed.mean()
    assert summary["status"] == "done"
    assert {key: summary[key] for key in record["metrics"]} == record["metrics"]
    assert summary["views"] == record["views"]


@pytest.mark.usefixtures("undrawn")
def test_a_canonical_frame_brings_its_weights_and_may_stay_rigid(inputs, tmp_path):
    mesh = inputs / "round" / "canonical.npz"
    succeeded(run(mesh, tmp_path, inputs, "--rigid", "--json", head=False))
    record = read_json(tmp_path / "result.json")
    assert record["name"] == "round"
    assert record["options"]["bend"] is False
    assert record["metrics"]["bend_max_mm"] == 0
    assert "the glasses bring their own" in {step["reason"] for step in record["plan"]}
    assert "keypoints" not in record["inputs"]


@pytest.mark.usefixtures("undrawn")
def test_a_view_without_a_mask_has_labels_only(changed, tmp_path):
    (changed / "masks" / "camera_2.png").unlink()
    mesh, out = changed / "round" / "canonical.npz", tmp_path / "out"
    answer = succeeded(run(mesh, out, changed, head=False))
    assert "no mask of 'camera_2'" in answer.stderr
    views = read_json(out / "result.json")["views"]
    assert [view["mask"] for view in views] == [True, False, True]
    assert views[1]["outline_rms_px"] is None
    assert views[0]["iou"] > 0.5


def test_pictures_end_where_cameras_say_even_without_masks(changed, person, tmp_path):
    tree = read_json(changed / "cameras.json")
    middle = person.keypoints[0]  # of the bridge
    pixel = np.array(tree["cameras"][1]["matrix"]) @ [*middle, 1]
    tree["cameras"][1]["width"] = int(pixel[0] / pixel[2])
    (changed / "cameras.json").write_text(json.dumps(tree))
    given = read_registration(
        changed / "round" / "canonical.npz", changed / "cameras.json", changed / "labels.json"
    )
    assert any("lie outside its picture" in note for note in given.notes)
    frame = register_frame(given).result
    shown = frame.vertices @ given.cameras[1].matrix[:, :3].T + given.cameras[1].matrix[:, 3]
    inside = shown[:, 0] / shown[:, 2] <= tree["cameras"][1]["width"] - 0.5
    assert 0.3 < inside.mean() < 0.7
    assert_array_equal(frame.visible[1], inside)
    assert frame.visible[0].all()


@pytest.mark.usefixtures("undrawn")
def test_a_start_fixes_what_labels_do_not(changed, person, tmp_path):
    labels = read_labels(changed / "labels.json")
    pixels = np.full_like(labels.pixels, np.nan)
    pixels[0, :2] = labels.pixels[0, :2]
    write_labels(changed / "labels.json", pixels, labels.camera_names)
    mesh, out = changed / "round" / "canonical.npz", tmp_path / "out"
    lost = run(mesh, out, changed, "--json", head=False)
    usage_error(lost)
    assert json.loads(lost.stdout)["status"] == "failed"
    assert "fix no pose" in json.loads(lost.stdout)["reason"]

    nudge = compose(rotation_from_vector([0, 0.01, 0]), [0.5, 0, 0]) @ person.world_from_glasses
    write_start(tmp_path / "start.json", nudge)
    answer = succeeded(run(mesh, out, changed, "--rigid", "--start", tmp_path / "start.json", head=False))
    assert "no label in the view of 'camera_2'" in answer.stderr
    found = read_registered(out / "registered.npz")
    front = person.glasses.rest_keypoints[2:8, 2].min() < person.glasses.rest_vertices[:, 2]
    assert np.linalg.norm(found.vertices - person.vertices, axis=1)[front].mean() < 1.5


def spoiled_pose(pose):
    """Return what writes a start with that pose."""

    def write(folder):
        tree = {"unit": "mm", "world_from_glasses": np.asarray(pose).tolist()}
        (folder / "start.json").write_text(json.dumps(tree))

    return write


def test_an_earlier_result_is_a_start_too(done, inputs):
    start = done[0] / "registered.npz"
    given = read_registration(
        inputs / "frame.obj", inputs / "cameras.json", inputs / "labels.json", start=start
    )
    assert_array_equal(given.start, read_registered(start).world_from_glasses)
    assert given.files["start"].sha256 == hashlib.sha256(start.read_bytes()).hexdigest()


@pytest.mark.usefixtures("undrawn")
def test_a_head_in_another_frame_is_told(inputs, tmp_path):
    head = load_scan(inputs / "head.glb")
    trimesh.Trimesh(head.vertices + [0, -400, 0], head.faces, process=False).export(tmp_path / "far.ply")
    mesh = inputs / "round" / "canonical.npz"
    more = ("--head", tmp_path / "far.ply", "--budget", 60)
    answer = succeeded(run(mesh, tmp_path / "out", inputs, *more, head=False))
    assert "are head and cameras in one frame?" in answer.stderr
    assert read_json(tmp_path / "out" / "result.json")["options"]["budget_s"] == 60


@pytest.mark.usefixtures("undrawn")
def test_a_budget_that_ends_is_told(inputs, tmp_path):
    answer = succeeded(
        run(inputs / "round" / "canonical.npz", tmp_path, inputs, "--budget", 0.001, head=False)
    )
    assert "not converged" in answer.stderr
    assert not read_json(tmp_path / "result.json")["converged"]


def relabelled(folder):
    labels = read_labels(folder / "labels.json")
    write_labels(folder / "labels.json", labels.pixels, [*labels.camera_names[:2], "side"])


def shrunk(folder):
    points = read_keypoints(folder / "frame.keypoints.json")
    write_keypoints(folder / "frame.keypoints.json", points, unit="cm")


SPOILED = {
    "labels of another camera": (relabelled, r"labels\.json: there are labels of a camera 'side'"),
    "no labels": (lambda f: (f / "labels.json").unlink(), r"labels\.json: No such file"),
    "no cameras": (lambda f: (f / "cameras.json").write_text("{}"), r"cameras\.json: unit"),
    "no masks": (lambda f: shutil.rmtree(f / "masks"), r"masks: the folder holds none of camera_1\.png"),
    "half a mask": (lambda f: cut(f / "masks" / "camera_1.png"), r"camera_1\.png"),
    "half a head": (lambda f: cut(f / "head.glb"), r"head\.glb"),
    "key points in cm": (shrunk, r"frame\.keypoints\.json: the glasses are"),
    "no mesh": (lambda f: (f / "frame.obj").unlink(), r"frame\.obj: cannot be read"),
    "a mirror as start": (spoiled_pose(np.diag([-1, 1, 1, 1])), r"start\.json: .*rot"),
    "a half start": (spoiled_pose(np.eye(4)[:3]), r"start\.json: world_from_glasses"),
}


@pytest.mark.parametrize("name", SPOILED)
def test_bad_input_is_one_line_that_names_the_file(name, changed, tmp_path):
    spoil, words = SPOILED[name]
    spoil(changed)
    start = changed / "start.json"
    more = ("--start", start) if start.exists() else ()
    line = refusal(run(changed / "frame.obj", tmp_path / "out", changed, *more))
    assert re.search(words, line), line
    assert not (tmp_path / "out").exists()


def test_another_unit_or_a_spoiled_canonical_frame_is_told(changed, tmp_path):
    mesh, tree = changed / "round" / "canonical.npz", read_json(changed / "cameras.json")
    (changed / "cameras.json").write_text(json.dumps(tree | {"unit": "m"}))
    told = usage_error(run(mesh, tmp_path / "out", changed))
    assert re.search(r"labels.json: the labels make a frame [0-9.e+]+ times as large", told)
    cut(mesh)
    assert "canonical.npz cannot be read" in usage_error(run(mesh, tmp_path / "out", changed))


def test_a_frame_without_key_points_gets_proposed_ones(changed, tmp_path):
    (changed / "frame.keypoints.json").unlink()
    answer = succeeded(run(changed / "frame.obj", tmp_path / "out", changed))
    assert "20 key points are proposed from its shape" in answer.stderr
    record = read_json(tmp_path / "out" / "result.json")
    assert any("proposed from its shape" in note for note in record["notes"])


def test_usage_errors_are_2_and_write_nothing(inputs, tmp_path):
    frame, canonical, out = inputs / "frame.obj", inputs / "round" / "canonical.npz", tmp_path / "out"
    for mesh, more in (
        (frame, ("--unit", "yard")),
        (frame, ("--budget", "0")),
        (canonical, ("--unit", "cm")),
        (canonical, ("--keypoints", inputs / "frame.keypoints.json")),
    ):
        assert "Traceback" not in usage_error(run(mesh, out, inputs, *more))
        assert not out.exists()


def test_a_file_in_the_place_of_the_demos_input_stays(person, tmp_path):
    for _ in range(2):
        write_wearer(person, None, tmp_path)
    file = tmp_path / "input" / "cameras.json"
    file.write_text("mine")
    with pytest.raises(OutputError, match=r"cameras\.json: no run of scan2albedo glasses demo wrote it"):
        write_wearer(person, None, tmp_path)
    assert file.read_text() == "mine"
