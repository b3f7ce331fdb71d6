"""Files of registered frames and of starts; what a view's picture holds without its mask."""

import numpy as np
import pytest
from helpers.eyeglasses import nearest_weights
from helpers.schemas import check_schema
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses import (
    read_canonical,
    read_registered,
    read_start,
    register_on_face,
    write_registered,
    write_start,
)
from scan2albedo.geometry.pinhole import look_at, project
from scan2albedo.geometry.rigid import compose, random_rotation
from scan2albedo.synthetic import eyeglasses

SHAPE = (300, 300)


GLASSES = eyeglasses(0)
CAMERAS = np.stack([look_at([x, 40, 500], [0, 0, -60], focal_px=500.0, shape=SHAPE) for x in (-250, 250)])


def registered(masks=None, **options):
    labels = np.stack([project(camera, GLASSES.keypoints)[0] for camera in CAMERAS])
    labels[1, 4:9] = np.nan
    weights = nearest_weights(GLASSES.vertices, GLASSES.keypoints)
    frame = (GLASSES.vertices, GLASSES.faces, GLASSES.keypoints, weights)
    return register_on_face(frame, labels, masks, CAMERAS, **options)


def test_registered_frames_come_back(tmp_path):
    made = registered()
    write_registered(tmp_path / "a.npz", made)
    found = read_registered(tmp_path / "a.npz")
    for name, value in vars(made).items():
        if name not in ("plan", "trace") and not name.startswith("proposed"):
            assert_array_equal(getattr(found, name), value)
            assert np.asarray(getattr(found, name)).dtype == np.asarray(value).dtype
    assert len(found.plan) == len(found.trace) == len(found.proposed_labels) == 0
    assert found.unobserved == made.unobserved


def test_files_that_are_no_registered_frames_are_named(tmp_path):
    write_registered(tmp_path / "a.npz", registered())
    arrays = dict(np.load(tmp_path / "a.npz"))
    spoiled = {
        "visible": (arrays["visible"][:, :-1], r"visible has shape \(2, 4305\).*\(2, 4306\)"),
        "iou": (arrays["iou"][:1], r"iou has shape \(1,\)"),
        "keypoints": (arrays["keypoints"][0], r"keypoints has shape \(3,\)"),
        "weights": (arrays["weights"].astype("U4"), "weights has shape .* of <U4"),
        "faces": (arrays["faces"] + 1, "faces are not those of its vertices"),
        "vertices": (np.full_like(arrays["vertices"], np.nan), "vertices are not finite"),
    }
    for name, (value, words) in spoiled.items():
        np.savez(tmp_path / "b.npz", **{**arrays, name: value})
        with pytest.raises(EyeglassesError, match=rf"b\.npz: {words}"):
            read_registered(tmp_path / "b.npz")
    whole = (tmp_path / "a.npz").read_bytes()
    (tmp_path / "half.npz").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "flipped.npz").write_bytes(whole[:2000] + bytes(100) + whole[2100:])
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
        found = read_start(tmp_path / "start.json")
        assert_array_equal(found[:3, :3], pose[:3, :3])
        assert_allclose(found[:3, 3], mm * pose[:3, 3], rtol=1e-15)
    check_schema(tmp_path / "start.json", "eyeglasses_start")


@pytest.mark.parametrize("pose", [2 * np.eye(4), np.diag([1, 1, -1, 1]), np.full((4, 4), np.nan), np.eye(3)])
def test_starts_are_rigid(tmp_path, pose):
    with pytest.raises(ValueError, match="world_from_glasses"):
        write_start(tmp_path / "start.json", pose)
    assert not (tmp_path / "start.json").exists()
    with pytest.raises(EyeglassesError, match=r"none\.json.*write_start"):
        read_start(tmp_path / "none.json")


def test_shapes_tell_what_lies_outside_of_pictures_without_masks():
    pixels = project(CAMERAS[0], GLASSES.vertices)[0]
    width = int(np.median(pixels[:, 0]))
    cut = registered(shapes=[(300, width), SHAPE])
    assert_array_equal(cut.visible[0], pixels[:, 0] <= width - 0.5)
    assert registered().visible.all()
    with pytest.raises(ValueError, match="one entry for each of 2 cameras, got 1"):
        registered(shapes=[SHAPE])
    with pytest.raises(ValueError, match=r"mask 0 has shape \(300, 200\), expected its picture's"):
        registered([np.ones((300, 200)), None], shapes=[SHAPE] * 2)
