"""Files of views: labels, cameras and masks."""

import numpy as np
import pytest
from helpers.json_files import changed
from helpers.records import files_in
from helpers.schemas import check_schema
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.errors import EyeglassesError, OutputError
from scan2albedo.eyeglasses import (
    KEY_POINT_NAMES,
    Camera,
    ViewLabels,
    read_cameras,
    read_labels,
    read_masks,
    write_cameras,
    write_labels,
    write_masks,
)
from scan2albedo.geometry.pinhole import look_at
from scan2albedo.io.images import write_png

SHAPE = (480, 640)


def camera(name="front", side=0.0):
    matrix = look_at([side, 50, 600], [0, 0, 0], focal_px=900.0, shape=SHAPE)
    return Camera(name, matrix, SHAPE)


def test_labels_come_back_and_fit_their_schema(tmp_path):
    path, names = tmp_path / "labels.json", ("front", "left eye", "r")
    labels = np.arange(120.0).reshape(3, 20, 2)
    labels[1, 4] = np.nan
    labels[2] = np.nan
    write_labels(path, labels, names)
    found = read_labels(path)
    assert found.camera_names == names
    assert_array_equal(found.pixels, labels)
    wrong = [{"views": {"front": entry}} for entry in ({"nose": [1, 2]}, {"left_hinge": [1]})]
    check_schema(path, "eyeglasses_labels", *wrong, {"unit": "mm"})
    changed(path, lambda tree: tree["views"]["front"].pop("left_hinge"))
    labels[0, KEY_POINT_NAMES.index("left_hinge")] = np.nan
    assert_array_equal(read_labels(path).pixels, labels)


def test_labels_follow_the_order_of_the_cameras():
    first, second = np.arange(80.0).reshape(2, 20, 2)
    labels = ViewLabels(("a", "b"), np.stack([first, second]))
    gap = np.full((20, 2), np.nan)
    assert_array_equal(labels.of_cameras(["b", "other", "a"]), [second, gap, first])
    with pytest.raises(EyeglassesError, match="labels of a camera 'b', but the cameras are a"):
        labels.of_cameras(["a"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"views": {"front": {"nose": [1, 2]}}}', "'nose' is not a key point"),
        ('{"views": {"front": {"left_hinge": [1, NaN]}}}', "left_hinge.*finite"),
        ('{"views": {"a/b": {}}}', "cannot be named 'a/b'"),
        ('{"views": {"A": {}, "a": {}}}', "two cameras are named"),
        ('{"format": "other", "views": {}}', "format"),
    ],
)
def test_faults_of_labels_name_the_file(tmp_path, text, message):
    (tmp_path / "broken.json").write_text(text)
    with pytest.raises(EyeglassesError, match=rf"broken\.json.*{message}"):
        read_labels(tmp_path / "broken.json")


def test_labels_of_another_shape_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"labels is \(1, 20, 2\), expected \(2, 20, 2\)"):
        write_labels(tmp_path / "a.json", np.zeros((1, 20, 2)), ["a", "b"])
    with pytest.raises(ValueError, match="two cameras are named 'a'"):
        write_labels(tmp_path / "a.json", np.zeros((2, 20, 2)), ["a", "a"])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("unit", "mm"), [("mm", 1.0), ("cm", 10.0), ("m", 1000.0)])
def test_cameras_come_back_in_mm_and_fit_their_schema(tmp_path, unit, mm):
    cameras = [camera(), camera("side", 300.0)]
    write_cameras(tmp_path / "cameras.json", cameras, unit=unit)
    found = read_cameras(tmp_path / "cameras.json")
    assert [(c.name, c.shape) for c in found] == [("front", SHAPE), ("side", SHAPE)]
    for a, b in zip(found, cameras, strict=True):
        assert_allclose(a.matrix, b.matrix, rtol=1e-15)
    # What is in the file takes points in the file's unit to the same pixels.
    tree = check_schema(tmp_path / "cameras.json", "cameras", {"unit": "unknown"}, {"cameras": []})
    assert_allclose(tree["cameras"][1]["matrix"], cameras[1].matrix * [mm, mm, mm, 1], rtol=1e-15)


FLAT = [[900.0, 0, 0, 1], [0, 900.0, 0, 1], [0, 0, 0, 1.0]]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"matrix": FLAT}, "camera 'b'.*singular"),
        ({"matrix": (np.nan * np.ones((3, 4))).tolist()}, "camera 'b'.*NaN"),
        ({"matrix": FLAT[:2]}, r"cameras\.1\.matrix"),
        ({"width": 0}, r"cameras\.1\.width"),
        ({"name": "A"}, "two cameras are named"),
        ({"name": ".."}, r"cannot be named '\.\.'"),
    ],
)
def test_cameras_that_are_none_are_refused_by_file_and_name(tmp_path, changes, words):
    write_cameras(tmp_path / "cameras.json", [camera("a"), camera("b")])
    changed(tmp_path / "cameras.json", lambda tree: tree["cameras"][1].update(changes))
    with pytest.raises(EyeglassesError, match=rf"cameras\.json.*{words}"):
        read_cameras(tmp_path / "cameras.json")
    with pytest.raises(EyeglassesError, match=r"No such file.*write_cameras"):
        read_cameras(tmp_path / "none.json")


@pytest.mark.parametrize(
    ("matrix", "shape", "words"),
    [(np.eye(4), SHAPE, r"matrix is \(4, 4\), expected \(3, 4\)"), (np.eye(3, 4), (0, 5), "picture's shape")],
)
def test_cameras_of_other_shapes_are_refused(matrix, shape, words):
    with pytest.raises(ValueError, match=words):
        Camera("a", matrix, shape)


SMALL = Camera("small", camera().matrix, (5, 7))


def test_masks_come_back(tmp_path):
    cameras, folder = [camera(), SMALL], tmp_path / "masks"
    masks = [np.random.default_rng(0).random(c.shape) < 0.3 for c in cameras]
    write_masks(folder, masks, cameras)
    assert files_in(folder) == {"front.png", "small.png"}
    for found, mask in zip(read_masks(folder, cameras), masks, strict=True):
        assert_array_equal(found, mask)
    # Any value but 0 in any channel counts, as label pictures have it.
    colors = np.zeros((5, 7, 3), np.uint8)
    colors[2, 3, 2] = 1
    colors[4, 6, 0] = 255
    write_png(folder / "small.png", colors)
    assert np.argwhere(read_masks(folder, [SMALL])[0]).tolist() == [[2, 3], [4, 6]]


def test_masks_that_do_not_fit_name_the_file(tmp_path):
    path = tmp_path / "small.png"

    def refused(words):
        with pytest.raises(EyeglassesError, match=rf"small\.png {words}"):
            read_masks(tmp_path, [SMALL])

    refused("is missing")
    write_png(path, np.zeros((7, 5), bool))
    refused("is 5 x 7 pixels, its camera's picture 7 x 5")
    path.write_bytes(b"no picture")
    refused("cannot be decoded")
    for count, shape, kind, words in (
        (1, (3, 3), ValueError, r"shape \(3, 3\), expected \(5, 7\)"),
        (2, SMALL.shape, ValueError, "2 masks for 1 cameras"),
        (1, SMALL.shape, OutputError, "cannot create the folder"),
    ):
        with pytest.raises(kind, match=words):
            write_masks(path, np.ones((count, *shape)), [SMALL])
