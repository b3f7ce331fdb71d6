"""Files of views: labels, cameras and masks."""

import json

import numpy as np
import pytest
from helpers.schemas import check_schema
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.errors import EyeglassesError, OutputError
from scan2albedo.eyeglasses import (
    KEY_POINT_NAMES,
    Camera,
    read_cameras,
    read_labels,
    read_masks,
    write_cameras,
    write_labels,
    write_masks,
)
from scan2albedo.geometry.pinhole import look_at, normalized_cameras, project
from scan2albedo.io.images import write_png

SHAPE = (480, 640)


def camera(name="front", side=0.0):
    matrix = look_at([side, 50, 600], [0, 0, 0], focal_px=900.0, shape=SHAPE)
    return Camera(name, matrix, SHAPE)


def rewritten(path, change):
    """Let `change` edit the JSON tree of a file; NaN is written as Python does."""
    tree = json.loads(path.read_text())
    change(tree)
    path.write_text(json.dumps(tree))
    return path


def test_labels_come_back_and_fit_their_schema(tmp_path):
    labels = np.random.default_rng(0).uniform(0, 1000, (3, 20, 2))
    labels[1, 4] = np.nan
    labels[2] = np.nan
    labels[0, 0] = 0.0
    write_labels(tmp_path / "labels.json", labels, ["front", "left eye", "r"])
    found = read_labels(tmp_path / "labels.json")
    assert found.camera_names == ("front", "left eye", "r")
    assert_array_equal(found.pixels, labels)
    check_schema(
        tmp_path / "labels.json",
        "eyeglasses_labels",
        {"views": {"front": {"nose": [1, 2]}}},
        {"views": {"front": {"left_hinge": [1]}}},
        {"unit": "mm"},
    )
    rewritten(tmp_path / "labels.json", lambda tree: tree["views"]["front"].pop("left_hinge"))
    gone = np.isnan(read_labels(tmp_path / "labels.json").pixels[0]).all(1)
    assert np.array(KEY_POINT_NAMES)[gone].tolist() == ["left_hinge"]


def test_labels_follow_the_order_of_the_cameras(tmp_path):
    labels = np.random.default_rng(0).uniform(0, 1000, (2, 20, 2))
    write_labels(tmp_path / "labels.json", labels, ["a", "b"])
    found = read_labels(tmp_path / "labels.json").of_cameras(["b", "other", "a"])
    assert_array_equal(found[[0, 2]], labels[[1, 0]])
    assert np.isnan(found[1]).all()
    with pytest.raises(EyeglassesError, match="labels of a camera 'b', but the cameras are a"):
        read_labels(tmp_path / "labels.json").of_cameras(["a"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "Invalid JSON"),
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
    stored = np.array(json.loads((tmp_path / "cameras.json").read_text())["cameras"][1]["matrix"])
    points = np.random.default_rng(0).normal(0, 50, (5, 3))
    expected = project(normalized_cameras([cameras[1].matrix])[0], points)[0]
    assert_allclose(project(normalized_cameras([stored])[0], points / mm)[0], expected, atol=1e-9)
    check_schema(tmp_path / "cameras.json", "cameras", {"unit": "unknown"}, {"cameras": []})


def test_cameras_that_are_none_are_refused_by_file_and_name(tmp_path):
    path = tmp_path / "cameras.json"

    def refused(change, message):
        write_cameras(path, [camera("a"), camera("b")])
        with pytest.raises(EyeglassesError, match=rf"cameras\.json.*{message}"):
            read_cameras(rewritten(path, change))

    def put(key, value):
        return lambda tree: tree["cameras"][1].update({key: value})

    flat = [[900.0, 0, 0, 1], [0, 900.0, 0, 1], [0, 0, 0, 1.0]]
    refused(put("matrix", flat), "camera 'b'.*singular")
    refused(put("matrix", [[1.0, 2, 3, 4]] * 3), "camera 'b'.*singular")
    refused(put("matrix", [[np.nan, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]), "camera 'b'.*NaN")
    refused(put("matrix", flat[:2]), r"cameras\.1\.matrix")
    refused(put("width", 0), r"cameras\.1\.width")
    refused(put("name", "A"), "two cameras are named")
    refused(put("name", ".."), r"cannot be named '\.\.'")
    refused(lambda tree: tree.pop("unit"), "unit")
    with pytest.raises(EyeglassesError, match=r"No such file.*write_cameras"):
        read_cameras(tmp_path / "none.json")
    with pytest.raises(ValueError, match=r"matrix is \(4, 4\), expected \(3, 4\)"):
        Camera("a", np.eye(4), SHAPE)
    with pytest.raises(ValueError, match="picture's shape"):
        Camera("a", camera().matrix, (0, 5))


def test_masks_come_back(tmp_path):
    cameras = [camera(), Camera("small", camera().matrix, (5, 7))]
    rng = np.random.default_rng(0)
    masks = [rng.random(c.shape) < 0.3 for c in cameras]
    write_masks(tmp_path / "masks", masks, cameras)
    assert sorted(p.name for p in (tmp_path / "masks").iterdir()) == ["front.png", "small.png"]
    for found, mask in zip(read_masks(tmp_path / "masks", cameras), masks, strict=True):
        assert_array_equal(found, mask)
    # Any value but 0 in any channel counts, as label pictures have it.
    colors = np.zeros((5, 7, 3), np.uint8)
    colors[2, 3], colors[4, 6] = (0, 0, 1), (255, 0, 0)
    write_png(tmp_path / "masks" / "small.png", colors)
    assert np.argwhere(read_masks(tmp_path / "masks", cameras[1:])[0]).tolist() == [[2, 3], [4, 6]]


def test_masks_that_do_not_fit_name_the_file(tmp_path):
    small = Camera("small", camera().matrix, (5, 7))
    with pytest.raises(EyeglassesError, match=r"small\.png is missing"):
        read_masks(tmp_path, [small])
    write_png(tmp_path / "small.png", np.zeros((7, 5), bool))
    with pytest.raises(EyeglassesError, match=r"small\.png is 5 x 7 pixels, its camera's picture 7 x 5"):
        read_masks(tmp_path, [small])
    (tmp_path / "small.png").write_bytes(b"no picture")
    with pytest.raises(EyeglassesError, match=r"small\.png cannot be decoded"):
        read_masks(tmp_path, [small])
    with pytest.raises(ValueError, match=r"shape \(3, 3\), expected \(5, 7\)"):
        write_masks(tmp_path, [np.ones((3, 3))], [small])
    with pytest.raises(ValueError, match="2 masks for 1 cameras"):
        write_masks(tmp_path, [np.ones((5, 7))] * 2, [small])
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError, match="cannot create the folder"):
        write_masks(tmp_path / "file", [np.ones((5, 7))], [small])
