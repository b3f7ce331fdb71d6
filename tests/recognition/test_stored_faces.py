"""Albedos from folders and images; what is missing or foreign is named."""

import json
import shutil

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from scan2albedo.errors import RecognitionError
from scan2albedo.io.images import write_exr, write_png
from scan2albedo.recognition import certainty, read_face
from scan2albedo.synthetic import face


@pytest.fixture
def folder(people, tmp_path):
    return shutil.copytree(people / "ann", tmp_path / "ann")


def test_a_folder_gives_albedo_seen_texels_and_chart(stored, tmp_path):
    hidden = np.zeros((64, 64), bool)
    hidden[30:40, 20:50] = True
    folder = stored(tmp_path / "ann", 0, hidden=hidden, model="mine")
    scene, read = face(0, size=64), read_face(folder)
    assert_array_equal(read.values, scene.albedo_linear)
    assert_array_equal(read.certainty > 0, scene.image.mask & ~hidden)
    assert (read.chart.model, read.chart.shape) == ("mine", (64, 64))
    of_file = read_face(folder / "albedo.exr")
    assert_array_equal(of_file.certainty > 0, read.certainty > 0)


def test_of_a_face_that_nothing_shows_nothing_is_certain():
    assert not certainty(np.ones((4, 4)), np.ones((4, 4)), np.zeros((4, 4), bool)).any()


def test_processed_scans_are_read_too(folder):
    (folder / "application.json").unlink()
    record = {key: {} for key in ("versions", "metrics", "parameters", "timings_s")}
    record |= {"scan2albedo_version": "0", "name": "ann", "seed": 0, "options": {"model": "mine"}, "plan": []}
    record["input"] = {"sha256": "0" * 64, "vertices": 3, "faces": 1}
    (folder / "result.json").write_text(json.dumps(record))
    assert read_face(folder).chart.model == "mine"
    (folder / "result.json").write_text(json.dumps(record | {"options": {"model": "none"}}))
    with pytest.raises(RecognitionError, match="without a model"):
        read_face(folder)


@pytest.mark.parametrize("name", ["application.json", "geometry_image.npz", "albedo.exr"])
def test_what_is_missing_or_damaged_is_named(folder, name):
    whole = (folder / name).read_bytes()
    (folder / name).write_bytes(whole[: len(whole) // 3])
    with pytest.raises(RecognitionError, match=name.replace(".", r"\.")):
        read_face(folder)
    (folder / name).unlink()
    words = f"{name}: is missing"
    if name == "application.json":  # images alone are on a model's chart, nobody knows which
        assert read_face(folder).chart.model is None
        (folder / "geometry_image.npz").unlink()
        words = "holds no result"
    with pytest.raises(RecognitionError, match=words):
        read_face(folder)


def test_files_of_different_runs_are_refused(folder):
    write_exr(folder / "albedo.exr", np.ones((20, 20, 3)))
    with pytest.raises(RecognitionError, match="different runs"):
        read_face(folder)


def test_images_count_where_they_are_opaque_or_not_black(tmp_path):
    scene = face(0, size=64)
    mask, albedo = scene.image.mask, scene.albedo_linear
    assert not mask.all()
    write_exr(tmp_path / "black.exr", albedo)
    write_exr(tmp_path / "alpha.exr", np.dstack([albedo, mask]))
    white = np.where(mask[..., None], np.round(255 * albedo), 255)
    write_png(tmp_path / "alpha.png", np.dstack([white, 255 * mask]).astype(np.uint8))
    for name in ("black.exr", "alpha.exr", "alpha.png"):
        read = read_face(tmp_path / name)
        assert_array_equal(read.certainty > 0, mask, err_msg=name)
        assert (read.chart.model, read.chart.shape) == (None, (64, 64))


def test_other_files_are_refused(tmp_path):
    for name, words in (
        ("gallery.npz", r"a file of templates \(\.npz\) stands for a whole gallery"),
        ("notes.txt", "neither the folder of a processed scan nor an image"),
        ("bad.png", r"bad\.png"),
    ):
        (tmp_path / name).write_bytes(b"no picture")
        with pytest.raises(RecognitionError, match=words):
            read_face(tmp_path / name)
