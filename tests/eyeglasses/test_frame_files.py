"""Files of registered frames and of starts; what a view's picture holds without its mask."""

import numpy as np
import pytest
from helpers.eyeglasses import nearest_weights
from helpers.json_files import changed
from helpers.npz import rewritten
from helpers.schemas import check_schema
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses import (
    canonicalize,
    read_canonical,
    read_registered,
    read_start,
    register_on_face,
    write_canonical,
    write_registered,
    write_start,
)
from scan2albedo.geometry.pinhole import look_at, project
from scan2albedo.geometry.rigid import compose, random_rotation
from scan2albedo.synthetic import eyeglasses

SHAPE = (300, 300)


GLASSES = eyeglasses(0)
WEIGHTS = nearest_weights(GLASSES.vertices, GLASSES.keypoints)
CAMERAS = np.stack([look_at([x, 40, 500], [0, 0, -60], focal_px=500.0, shape=SHAPE) for x in (-250, 250)])


def registered(masks=None, **options):
    labels = np.stack([project(camera, GLASSES.keypoints)[0] for camera in CAMERAS])
    labels[1, 4:9] = np.nan
    frame = (GLASSES.vertices, GLASSES.faces, GLASSES.keypoints, WEIGHTS)
    return register_on_face(frame, labels, masks, CAMERAS, **options)


def canonical():
    return canonicalize([GLASSES], [GLASSES.keypoints], weights=[WEIGHTS]).frames[0]


@pytest.mark.parametrize(
    ("make", "write", "read"),
    [(registered, write_registered, read_registered), (canonical, write_canonical, read_canonical)],
)
def test_frames_come_back(tmp_path, make, write, read):
    made = make()
    write(tmp_path / "a.npz", made)
    found = read(tmp_path / "a.npz")
    for name, value in vars(made).items():
        back = getattr(found, name)
        if name in ("plan", "trace") or name.startswith("proposed"):
            assert len(back) == 0
        else:
            assert_array_equal(back, value)
            assert np.asarray(back).dtype == np.asarray(value).dtype


def test_files_that_are_no_registered_frames_are_named(tmp_path):
    made = registered()
    for name, value, words in (
        ("visible", made.visible[:, :-1], r"visible has shape \(2, 4305\).*\(2, 4306\)"),
        ("keypoints", made.keypoints[0], r"keypoints has shape \(3,\)"),
        ("weights", made.weights.astype("U4"), "weights has shape .* of <U4"),
        ("faces", made.faces + 1, "faces are not those of its vertices"),
        ("vertices", made.vertices + np.nan, "vertices are not finite"),
    ):
        write_registered(tmp_path / "a.npz", made)
        rewritten(tmp_path / "a.npz", **{name: value})
        with pytest.raises(EyeglassesError, match=rf"a\.npz: {words}"):
            read_registered(tmp_path / "a.npz")
    write_registered(tmp_path / "a.npz", made)
    whole = (tmp_path / "a.npz").read_bytes()
    (tmp_path / "flipped.npz").write_bytes(whole[:2000] + bytes(100) + whole[2100:])
    (tmp_path / "half.npz").write_bytes(whole[:5000])
    np.save(tmp_path / "one.npy", np.zeros(3))
    for name in ("half.npz", "flipped.npz", "one.npy", "none.npz"):
        with pytest.raises(EyeglassesError, match=name):
            read_registered(tmp_path / name)
    with pytest.raises(EyeglassesError, match=r"a\.npz cannot be read .*canonical_from_frame"):
        read_canonical(tmp_path / "a.npz")


def test_starts_come_back_in_mm(tmp_path):
    pose = compose(random_rotation(np.random.default_rng(0)), [10.0, -20, 30])
    for unit, mm in (("mm", 1), ("cm", 10), ("m", 1000)):
        write_start(tmp_path / "start.json", pose, unit=unit)
        expected = compose(pose[:3, :3], mm * pose[:3, 3])
        assert_allclose(read_start(tmp_path / "start.json"), expected, rtol=1e-15)
    check_schema(tmp_path / "start.json", "eyeglasses_start")


@pytest.mark.parametrize(
    ("pose", "words"),
    [
        (2 * np.eye(4), "must be a rotation"),
        (np.diag([1, 1, -1, 1]), "must be a rotation"),
        (np.eye(4)[:3], "world_from_glasses"),
    ],
)
def test_starts_are_rigid(tmp_path, pose, words):
    path = tmp_path / "start.json"
    with pytest.raises(ValueError, match=words):
        write_start(path, pose)
    assert not path.exists()
    write_start(path, np.eye(4))
    changed(path, lambda tree: tree.update(world_from_glasses=pose.tolist()))
    with pytest.raises(EyeglassesError, match=rf"start\.json: .*{words}"):
        read_start(path)
    with pytest.raises(EyeglassesError, match=r"none\.json.*write_start"):
        read_start(tmp_path / "none.json")


def test_shapes_tell_what_lies_outside_of_pictures_without_masks():
    columns = project(CAMERAS[0], GLASSES.vertices)[0][:, 0]
    width = int(np.median(columns))
    found = registered(shapes=[(300, width), SHAPE])
    assert_array_equal(found.visible[0], columns <= width - 0.5)
    assert registered().visible.all()
    with pytest.raises(ValueError, match="one entry for each of 2 cameras, got 1"):
        registered(shapes=[SHAPE])
    with pytest.raises(ValueError, match=r"mask 0 has shape \(300, 200\), expected its picture's"):
        registered([np.ones((300, 200)), None], shapes=[SHAPE] * 2)
