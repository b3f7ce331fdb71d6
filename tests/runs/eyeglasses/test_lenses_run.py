"""Lenses in registered frames from files and to files, and the command for it."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.cli import invoke
from helpers.commands import printed, refusal, succeeded
from helpers.eyeglasses import outline_distances
from helpers.lens_frames import frame_mask, half_rimless
from helpers.measures import rms
from helpers.meshes import sphere
from helpers.records import files_in, read_json, valid_record
from helpers.usage import usage_error
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.core import RawScan
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses import (
    Camera,
    LensMaterial,
    LensPictureOptions,
    Surface,
    write_cameras,
    write_keypoints,
    write_masks,
)
from scan2albedo.eyeglasses.lenses.scenes import WHITE_SHOWN, soft_environment, white_exposure
from scan2albedo.eyeglasses.mean_keypoints import RIMS, own_axes
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.pinhole import look_at
from scan2albedo.geometry.rigid import random_rotation
from scan2albedo.io.glb import write_glb
from scan2albedo.io.images import read_image_linear, write_exr, write_png
from scan2albedo.io.input_hash import file_sha256, input_sha256
from scan2albedo.io.obj import write_obj
from scan2albedo.lighting.environment import texel_directions, texel_solid_angles
from scan2albedo.runs.eyeglasses.inputs import material_pair, read_lens_scene
from scan2albedo.runs.eyeglasses.lenses_run import render_lenses, surface_of
from scan2albedo.synthetic import eyeglasses

pytestmark = pytest.mark.slow

SHAPE = (48, 64)
BENT = eyeglasses(1)
COMMON = {"frame_with_lenses.glb", "result.json", "overview.png"}
QUICK = ("--lights", 4, "--supersampling", 2)


def view(name, position):
    return Camera(name, look_at(position, [0, 0, -20], focal_px=220, shape=SHAPE), SHAPE)


VIEWS = (view("front", [0, 0, 600]), view("side", [250, 40, 520]))


SKIN = Surface(*sphere(4, 95.0, [0, 0, -110]))
"""A ball behind the frame, as large as a head."""


def drawn(head=SKIN, cameras=VIEWS, **more):
    """Draw the frame with plain lenses."""
    frame = Surface(BENT.vertices, BENT.faces)
    return render_lenses(frame, BENT.keypoints, LensMaterial(), head=head, cameras=cameras, **more)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A frame in metres with key points in mm, a head in cm, cameras for mm, two photographs."""
    folder = tmp_path_factory.mktemp("worn")
    write_glb(folder / "registered.glb", BENT.vertices, BENT.faces)
    write_keypoints(folder / "keypoints.json", BENT.keypoints)
    write_obj(folder / "head.obj", SKIN.vertices / 10, SKIN.faces)
    write_cameras(folder / "cameras.json", VIEWS)
    for camera in VIEWS:
        write_png(folder / f"{camera.name}.png", np.random.default_rng(0).random((*SHAPE, 3)))
    write_exr(folder / "room.exr", np.random.default_rng(1).random((8, 16, 3)))
    return folder


def run(folder, *arguments, frame="registered.glb", **given):
    named = {"--cameras": folder / "cameras.json", "--head": folder / "head.obj"}
    named |= {f"--{name}": value for name, value in given.items()}
    options = [part for pair in named.items() for part in pair]
    return invoke("glasses", "lenses", folder / frame, *options, *QUICK, *arguments)


def test_the_input_has_the_hashes_of_what_was_read(files, tmp_path):
    copy = shutil.copytree(files, tmp_path / "copy")
    names = {"mesh": "registered.glb", "head": "head.obj", "cameras": "cameras.json"}
    names |= {"environment": "room.exr", "keypoints": "keypoints.json"}
    paths = {what: copy / name for what, name in names.items()}
    meshes = ("head", "mesh")
    expected = {
        what: (str(path), input_sha256(path) if what in meshes else file_sha256(path))
        for what, path in paths.items()
    }
    frame, head, cameras, room, _ = paths.values()
    source = read_lens_scene(frame, head, cameras, environment=room)
    for path in paths.values():
        path.write_bytes(b"changed while pictures were drawn")
    assert {what: (file.file, file.sha256) for what, file in source.files.items()} == expected


def test_the_inside_of_an_open_face_is_not_drawn():
    """From behind, where a relit picture shows none of it either; a face wound inward stays."""
    front = SKIN.faces[SKIN.vertices[SKIN.faces].mean(1)[:, 2] > -110]
    shown = []
    for faces in (front, front[:, ::-1]):
        scene = drawn(
            Surface(SKIN.vertices, faces, (0, 0, 0)),
            [view("behind", [0, 0, -600])],
            environment_linear=np.full((8, 16, 3), 0.5),
            options=LensPictureOptions(supersampling=1, light_count=4),
        )
        shown.append((scene.views[0].picture.without_lenses_linear.max(2) < 1e-6).mean())
    # Temples in the shade of the face are dark too.
    assert shown[0] < 0.01 < 0.9 < shown[1]


def test_drawn_views_and_their_files(files, tmp_path):
    out = tmp_path / "out"
    summary = printed(run(files, "-o", out, "--dioptres", "-4,-2.5", "--fresnel", "--json"))
    pictures = {f"{name}_lenses.{kind}" for name in ("front", "side") for kind in ("png", "exr")}
    record = valid_record(out / "result.json", "eyeglasses_lenses")
    assert files_in(out) == set(record["files"]) == COMMON | pictures
    assert record["light"] == "built-in"
    assert record["mm_per_unit"] == 1000
    for lens, center, dioptres in zip(record["lenses"], BENT.lens_centers, (-4, -2.5), strict=True):
        assert np.linalg.norm(lens["center_mm"] - center) < 1
        assert (lens["dioptres"], lens["beta"], lens["measured"]) == (dioptres, 0.04, 1)
    assert summary["status"] == "done"
    assert summary["lenses"] == record["lenses"]
    # What stands in the files is what the library makes of the same things.
    source = read_lens_scene(files / "registered.glb", files / "head.obj", files / "cameras.json")
    rendered = render_lenses(
        surface_of(source.frame.scan, (0.05, 0.05, 0.06)),
        source.frame.keypoints,
        tuple(LensMaterial(dioptres, beta=0.04, fresnel=True) for dioptres in (-4.0, -2.5)),
        head=surface_of(source.head, (0.5, 0.5, 0.5), 0.3),
        cameras=source.cameras,
        options=LensPictureOptions(light_count=4, supersampling=2),
    )
    for made, seen in zip(rendered.views, record["views"], strict=True):
        stored = read_image_linear(out / f"{made.camera.name}_lenses.exr")
        assert_allclose(stored, made.picture.image_linear, rtol=1e-6, atol=1e-7)
        assert seen["left_lens_pixels"] == (made.picture.lens == 0).sum() > 50
        assert seen["unknown_pixels"] == 0
        preview = read_image_linear(out / f"{made.camera.name}_lenses.png")
        expected = np.clip(record["exposure"] * made.picture.image_linear, 0, 1)
        assert_allclose(preview, expected, atol=0.01)
    scene = trimesh.load_scene(out / "frame_with_lenses.glb")
    assert set(scene.geometry) == {"frame", "left_lens", "right_lens"}
    lens = scene.geometry["left_lens"]
    assert_allclose(1000 * lens.vertices, rendered.lenses[0].vertices, atol=1e-3)
    assert lens.visual.material.alphaMode == "BLEND"
    assert_allclose(1000 * scene.geometry["frame"].vertices, BENT.vertices, atol=1e-3)


def test_photographs_environment_and_views(files, tmp_path):
    out = tmp_path / "out"
    photograph = read_image_linear(files / "side.png")
    options = {"picture": files / "side.png", "environment": files / "room.exr", "view": "side"}
    succeeded(run(files, "-o", out, "--sunglasses", **options))
    made = {"side_lenses.png", "side_lenses.exr", "side_unknown.png"}
    assert files_in(out) == COMMON | made
    record = read_json(out / "result.json")
    assert (record["light"], record["exposure"]) == ("given", 1.0)
    assert [Path(p["file"]).name for p in record["pictures"]] == ["side.png"]
    lens = record["lenses"][0]
    assert (lens["tinting"], lens["alpha"], lens["fresnel"]) == ("filter", 0.85, True)
    stored = read_image_linear(out / "side_lenses.exr")
    changed = np.abs(stored - photograph).max(2) > 1e-6
    assert 0.02 < changed.mean() < 0.4
    # Dark glass: what changed got darker.
    assert stored[changed].mean() < 0.6 * photograph[changed].mean()
    # Both photographs in the wrong order are told apart by their names, and an older run's view goes.
    both = ("--picture", files / "side.png", "--picture", files / "front.png", "-o", out)
    succeeded(run(files, *both))
    names = [Path(p["file"]).name for p in read_json(out / "result.json")["pictures"]]
    assert names == ["front.png", "side.png"]
    succeeded(run(files, "-o", out, "--view", "front"))
    assert files_in(out) == COMMON | {"front_lenses.png", "front_lenses.exr"}


def test_masks_of_any_cameras_refine_the_rims(files, tmp_path):
    worn = shutil.copytree(files, tmp_path / "worn")
    write_glb(worn / "registered.glb", BENT.vertices, half_rimless(BENT))
    size, masks = (640, 640), worn / "masks"
    cameras = [
        Camera(f"camera {x}", look_at([x, 60, 500], [0, 0, -20], focal_px=1400, shape=size), size)
        for x in (-340, 0, 340)
    ]
    write_cameras(worn / "cameras.json", [*VIEWS, *cameras])
    shown = [frame_mask(BENT.vertices, BENT.faces, camera.matrix, size) for camera in cameras]
    write_masks(masks, shown, cameras)
    off, records = [], []
    for out, more in ((tmp_path / "bare", {}), (tmp_path / "masked", {"masks": masks})):
        succeeded(run(worn, "--view", "front", out=out, **more))
        records.append(valid_record(out / "result.json", "eyeglasses_lenses"))
        lens = trimesh.load_scene(out / "frame_with_lenses.glb").geometry["left_lens"]
        off.append(rms(outline_distances(1e3 * lens.vertices[1:], BENT.lens_outlines[0])))
    bare, masked = ([entry["deviation_mm"] for entry in record["lenses"]] for record in records)
    assert bare == [None, None]
    assert 0 < masked[1] < masked[0] < 1.5
    assert [len(record["masks"]) for record in records] == [0, 3]
    assert "the left lens: masks refine its outline" in "".join(records[1]["notes"])
    assert off[1] < 0.5 * off[0]
    shutil.rmtree(masks)
    assert "the folder holds none of front.png" in usage_error(run(worn, out=tmp_path / "none", masks=masks))


def test_each_bad_input_is_one_line_that_names_the_file(files, tmp_path):
    out = tmp_path / "out"
    marks = BENT.keypoints
    marks[2] = np.nan
    write_keypoints(tmp_path / "few.json", marks)
    write_obj(tmp_path / "far.obj", SKIN.vertices + [3000, 0, 0], SKIN.faces)
    write_png(tmp_path / "small.png", np.zeros((5, 5, 3)))
    (tmp_path / "broken.exr").write_bytes(b"nothing")
    for words, what, name in (
        ("few.json: the left lens needs the key points of its rim", "keypoints", "few.json"),
        ("none.obj", "head", "none.obj"),
        ("mm away from the head", "head", "far.obj"),
        ("small.png: there are 1 pictures for 2 views", "picture", "small.png"),
        ("broken.exr", "environment", "broken.exr"),
    ):
        answer = run(files, "-o", out, "--json", **{what: tmp_path / name})
        assert words in refusal(answer)
        summary = json.loads(answer.stdout)
        assert summary["status"] == "failed"
        assert words in summary["reason"]
        assert not out.exists() or list(out.iterdir()) == []
    for words, more in (
        ("cameras.json: there is no view 'back', only front, side", {"view": "back"}),
        ("small.png is 5 x 5 pixels", {"picture": tmp_path / "small.png", "view": "front"}),
        ("none.glb", {"frame": "none.glb"}),
    ):
        assert words in refusal(run(files, "-o", out, **more))


@pytest.mark.parametrize(
    "arguments",
    ["--dioptres much", "--dioptres 1,2,3", "--tint 1,2", "--alpha 2", "--lights 0", "--unit yard"],
)
def test_options_that_mean_nothing_are_usage_errors(files, tmp_path, arguments):
    usage_error(run(files, "-o", tmp_path / "out", *arguments.split()))
    assert not (tmp_path / "out").exists()


def test_lenses_of_the_commands_options():
    plain = {"tint": None, "alpha": None, "beta": None, "sunglasses": False, "fresnel": False}
    assert material_pair("3", **plain) == (LensMaterial(3.0),) * 2
    tinted = LensMaterial(0.0, (0.5, 0.2, 0.1), alpha=0.5, beta=0.1)
    assert material_pair("0", **{**plain, "tint": "0.5,0.2,0.1", "beta": 0.1}) == (tinted,) * 2
    dark = LensMaterial(-1.0, (0, 0, 0), alpha=0.5, beta=0.04, fresnel=True, tinting="filter")
    options = {"sunglasses": True, "alpha": 0.5, "tint": "0,0,0"}
    assert material_pair("-1", **{**plain, **options}) == (dark,) * 2


def test_a_heads_colours_are_used():
    rng = np.random.default_rng(0)
    mesh, grey = (np.eye(3), np.array([[0, 1, 2]])), (0.4, 0.5, 0.6)
    uv, colors = rng.random((1, 3, 2)), rng.random((3, 3)).astype(np.float32)
    textured = surface_of(RawScan(*mesh, uv=uv, texture_linear=colors[None]), grey)
    assert_array_equal(textured.texture_linear, colors[None], strict=True)
    assert_array_equal(surface_of(RawScan(*mesh, vertex_color_linear=colors), grey).albedo_linear, colors)
    assert_array_equal(surface_of(RawScan(*mesh), grey).albedo_linear, grey)


def test_the_built_in_room_turns_with_the_frame():
    pose = random_rotation(np.random.default_rng(3))
    axes = own_axes(BENT.keypoints)
    assert_allclose(axes, np.eye(3), atol=0.05)
    assert_allclose(own_axes(BENT.keypoints @ pose.T), axes @ pose.T, atol=1e-12)
    one = BENT.keypoints
    one[RIMS[1]] = np.nan
    assert_allclose(own_axes(one), axes, atol=0.05)
    assert_array_equal(own_axes(np.full((20, 3), np.nan)), np.eye(3))
    brightest = []
    for turned in (np.eye(3), pose.T):
        room = soft_environment(turned, rows=64)
        assert (room > 0).all()
        bright = (room[..., 0] > 0.9 * room.max()) * texel_solid_angles(64, 128)[:, None]
        brightest.append(normalized(np.tensordot(bright, texel_directions((64, 128)))))
    # Above, at the wearer's right, and in front.
    assert (brightest[0] * [-1, 1, 1] > 0.3).all()
    assert_allclose(pose @ brightest[0], brightest[1], atol=0.02)


def test_exposure_is_the_scenes_own():
    even, ahead = np.full((16, 32, 3), 2.0), np.array([0, 0, 1.0])
    assert white_exposure(even, ahead) == pytest.approx(WHITE_SHOWN / 2, rel=1e-3)
    front = np.where(texel_directions((16, 32))[..., 2:] > 0, [4.0] * 3, 0.0)
    assert white_exposure(front, ahead) == pytest.approx(WHITE_SHOWN / 4, rel=1e-2)
    # From behind it is dark there, and shown so.
    assert white_exposure(front, -ahead) == pytest.approx(WHITE_SHOWN / 2, rel=1e-2)
    assert white_exposure(0 * even, ahead) == 1.0
    options = LensPictureOptions(light_count=4, supersampling=1)
    both, side = (drawn(cameras=cameras, options=options) for cameras in (VIEWS, VIEWS[1:]))
    assert both.exposure == side.exposure
    assert_array_equal(both.views[1].picture.image_linear, side.views[0].picture.image_linear)
    assert f"{both.exposure:.3g}" in both.notes[-1]


@pytest.mark.parametrize(
    ("given", "error", "words"),
    [
        ({"cameras": []}, ValueError, "give a camera"),
        ({"pictures_linear": [np.zeros((*SHAPE, 3))]}, ValueError, "1 pictures for 2 cameras"),
        ({"pictures_linear": np.zeros((2, 4, 4, 3))}, ValueError, "picture of 'front'"),
        ({"head": Surface(SKIN.vertices + 900, SKIN.faces)}, EyeglassesError, "mm away from the head"),
    ],
)
def test_what_does_not_fit_together_is_refused(given, error, words):
    with pytest.raises(error, match=words):
        drawn(**given)
