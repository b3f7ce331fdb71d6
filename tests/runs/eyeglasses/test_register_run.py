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
from helpers.measures import rms, row_lengths
from helpers.npz import cut
from helpers.records import files_in, read_json, valid_record
from helpers.usage import usage_error
from helpers.wearers import small_wearer
from helpers.worn_frames import wearer_files
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
    write_canonical,
    write_keypoints,
    write_labels,
    write_start,
)
from scan2albedo.eyeglasses.mean_keypoints import front_width
from scan2albedo.geometry.pinhole import project
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
    made = wearer_files(person, tmp_path_factory.mktemp("wearer"))
    glasses = person.glasses
    found = canonicalize(
        [(glasses.rest_vertices, glasses.faces)],
        [glasses.rest_keypoints],
        mean_keypoints=glasses.rest_keypoints,
        spacing=3.0,
    )
    (made / "round").mkdir()
    write_canonical(made / "round" / "canonical.npz", found.frames[0])
    return made


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


def run(folder, out, *more, mesh="round/canonical.npz", head=True):
    """The answer of the command to the files of a folder."""
    options = {"cameras": "cameras.json", "labels": "labels.json", "masks": "masks"}
    options |= {"head": "head.glb"} if head else {}
    files = [part for what, name in options.items() for part in (f"--{what}", folder / name)]
    return invoke("glasses", "register", folder / mesh, "-o", out, *files, *more)


@pytest.fixture(scope="module")
def done(inputs, tmp_path_factory):
    """The frame from its mesh, through the command."""
    out = tmp_path_factory.mktemp("registered")
    return out, run(inputs, out, "--json", mesh="frame.obj")


def test_a_measured_front_sets_the_scale_of_a_frame(inputs):
    files = (inputs / "frame.obj", inputs / "cameras.json", inputs / "labels.json")
    usual, wide = (read_registration(*files, frame_width_mm=width).frame for width in (None, 200))
    assert front_width(wide.keypoints, wide.scan.vertices) == pytest.approx(200)
    factor = wide.mm_per_unit / usual.mm_per_unit
    assert_allclose(wide.scan.vertices, factor * usual.scan.vertices, rtol=1e-6)


def test_a_frame_lands_where_the_pictures_show_it(done, person):
    out, answer = done
    succeeded(answer)
    frame = read_registered(out / "registered.npz")
    # A pixel of these small pictures is 1.3 mm.
    assert rms(row_lengths(frame.vertices - person.vertices)[person.seen]) < 0.8
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
        digest = hashlib.sha256((inputs / name).read_bytes()).hexdigest()
        assert record["inputs"][what] == {"file": str(inputs / name), "sha256": digest}
    for view, name, iou in zip(record["views"], names, frame.iou, strict=True):
        assert (view["camera"], view["mask"], view["iou"]) == (name, True, iou)
    metrics = record["metrics"]
    assert metrics["label_rms_px"] == pytest.approx(rms(frame.label_errors_px[frame.inliers]))
    assert metrics["labels"] == np.isfinite(person.labels[:, :, 0]).sum()
    assert metrics["observed_share"] == frame.observed.mean()
    assert summary.items() >= {**metrics, "status": "done", "views": record["views"]}.items()


@pytest.mark.usefixtures("undrawn")
def test_a_canonical_frame_brings_its_weights_and_may_stay_rigid(inputs, tmp_path):
    succeeded(run(inputs, tmp_path, "--rigid", "--json", head=False))
    record = read_json(tmp_path / "result.json")
    assert record["name"] == "round"
    assert record["options"]["bend"] is False
    assert record["metrics"]["bend_max_mm"] == 0
    assert "the glasses bring their own" in {step["reason"] for step in record["plan"]}
    assert "keypoints" not in record["inputs"]


@pytest.mark.usefixtures("undrawn")
def test_a_view_without_a_mask_has_labels_only(changed, tmp_path):
    (changed / "masks" / "camera_2.png").unlink()
    out = tmp_path / "out"
    answer = succeeded(run(changed, out, head=False))
    assert "no mask of 'camera_2'" in answer.stderr
    views = read_json(out / "result.json")["views"]
    assert [view["mask"] for view in views] == [True, False, True]
    assert views[1]["outline_rms_px"] is None
    assert views[0]["iou"] > 0.5


def test_pictures_end_where_cameras_say_even_without_masks(changed, person, tmp_path):
    tree = read_json(changed / "cameras.json")
    pixels, _ = project(np.array(tree["cameras"][1]["matrix"]), person.keypoints[:1])  # of the bridge
    tree["cameras"][1]["width"] = int(pixels[0, 0])
    (changed / "cameras.json").write_text(json.dumps(tree))
    mesh = changed / "round" / "canonical.npz"
    given = read_registration(mesh, changed / "cameras.json", changed / "labels.json")
    assert any("lie outside its picture" in note for note in given.notes)
    visible = register_frame(given).result.visible.mean(1)
    assert 0.3 < visible[1] < 0.7
    assert visible[0] == 1


@pytest.mark.usefixtures("undrawn")
def test_a_start_fixes_what_labels_do_not(changed, person, tmp_path):
    labels = read_labels(changed / "labels.json")
    labels.pixels[0, 2:] = labels.pixels[1:] = np.nan
    write_labels(changed / "labels.json", labels.pixels, labels.camera_names)
    out, start = tmp_path / "out", tmp_path / "start.json"
    lost = run(changed, out, "--json", head=False)
    usage_error(lost)
    told = json.loads(lost.stdout)
    assert told["status"] == "failed"
    assert "fix no pose" in told["reason"]

    nudge = compose(rotation_from_vector([0, 0.01, 0]), [0.5, 0, 0]) @ person.world_from_glasses
    write_start(start, nudge)
    answer = succeeded(run(changed, out, "--rigid", "--start", start, head=False))
    assert "no label in the view of 'camera_2'" in answer.stderr
    found = read_registered(out / "registered.npz")
    front = person.glasses.rest_keypoints[2:8, 2].min() < person.glasses.rest_vertices[:, 2]
    assert row_lengths(found.vertices - person.vertices)[front].mean() < 1.5


def test_an_earlier_result_is_a_start_too(done, inputs):
    start = done[0] / "registered.npz"
    given = read_registration(inputs / "frame.obj", inputs / "cameras.json", start=start)
    assert_array_equal(given.start, read_registered(start).world_from_glasses)
    assert given.files["start"].sha256 == hashlib.sha256(start.read_bytes()).hexdigest()


@pytest.mark.usefixtures("undrawn")
def test_a_head_in_another_frame_is_told(inputs, tmp_path):
    head = load_scan(inputs / "head.glb")
    trimesh.Trimesh(head.vertices + [0, -400, 0], head.faces, process=False).export(tmp_path / "far.ply")
    more = ("--head", tmp_path / "far.ply", "--budget", 60)
    answer = succeeded(run(inputs, tmp_path / "out", *more, head=False))
    assert "are head and cameras in one frame?" in answer.stderr
    assert read_json(tmp_path / "out" / "result.json")["options"]["budget_s"] == 60


@pytest.mark.usefixtures("undrawn")
def test_a_budget_that_ends_is_told(inputs, tmp_path):
    answer = succeeded(run(inputs, tmp_path, "--budget", 0.001, head=False))
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
}


@pytest.mark.parametrize("name", SPOILED)
def test_bad_input_is_one_line_that_names_the_file(name, changed, tmp_path):
    spoil, words = SPOILED[name]
    spoil(changed)
    line = refusal(run(changed, tmp_path / "out", mesh="frame.obj"))
    assert re.search(words, line), line
    assert not (tmp_path / "out").exists()


def test_another_unit_or_a_spoiled_canonical_frame_is_told(changed, tmp_path):
    tree = read_json(changed / "cameras.json")
    (changed / "cameras.json").write_text(json.dumps(tree | {"unit": "m"}))
    told = usage_error(run(changed, tmp_path / "out"))
    assert re.search(r"labels.json: the labels make a frame [0-9.e+]+ times as large", told)
    cut(changed / "round" / "canonical.npz")
    assert "canonical.npz cannot be read" in usage_error(run(changed, tmp_path / "out"))


@pytest.mark.parametrize(
    ("mesh", "option", "value"),
    [
        ("frame.obj", "--unit", "yard"),
        ("frame.obj", "--budget", 0),
        ("round/canonical.npz", "--unit", "cm"),
        ("round/canonical.npz", "--keypoints", "frame.keypoints.json"),
    ],
)
def test_usage_errors_are_2_and_write_nothing(inputs, tmp_path, mesh, option, value):
    out = tmp_path / "out"
    assert "Traceback" not in usage_error(run(inputs, out, option, value, mesh=mesh))
    assert not out.exists()


def test_a_file_in_the_place_of_the_demos_input_stays(person, tmp_path):
    for _ in range(2):
        write_wearer(person, None, tmp_path)
    file = tmp_path / "input" / "cameras.json"
    file.write_text("mine")
    with pytest.raises(OutputError, match=r"cameras\.json: no run of scan2albedo glasses demo wrote it"):
        write_wearer(person, None, tmp_path)
    assert file.read_text() == "mine"
