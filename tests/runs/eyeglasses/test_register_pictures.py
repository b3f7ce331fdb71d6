"""Frames registered by the command from photographs alone."""

import numpy as np
import pytest
from helpers.cli import invoke
from helpers.commands import succeeded
from helpers.measures import row_lengths
from helpers.records import read_json
from helpers.usage import usage_error
from helpers.wearers import small_wearer
from helpers.worn_frames import front_error_mm, photographs, wearer_files

from scan2albedo.eyeglasses import read_cameras, read_labels, read_masks, read_registered
from scan2albedo.io.images import write_png

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def person():
    return small_wearer(1, 512)


@pytest.fixture(scope="module")
def inputs(person, tmp_path_factory):
    """A folder with the wearer's files, and photographs of a dark frame before mottled skin."""
    made = wearer_files(person, tmp_path_factory.mktemp("wearer"))
    folder = made / "photographs"
    folder.mkdir()
    for camera, picture in zip(read_cameras(made / "cameras.json"), photographs(person), strict=True):
        write_png(folder / f"{camera.name}.png", np.clip(picture, 0, 255).astype(np.uint8))
    return made


def run(folder, out, *more):
    arguments = [folder / "frame.obj", "-o", out, "--cameras", folder / "cameras.json", *more]
    return invoke("glasses", "register", *arguments)


def test_photographs_alone_place_a_frame_and_give_labels_to_correct(person, inputs, tmp_path):
    out = tmp_path / "out"
    succeeded(run(inputs, out, "--pictures", inputs / "photographs", "--head", inputs / "head.glb"))
    assert front_error_mm(read_registered(out / "registered.npz").vertices, person) < 1
    cameras = read_cameras(inputs / "cameras.json")
    proposed = read_labels(out / "proposed_labels.json").of_cameras([camera.name for camera in cameras])
    assert np.nanmedian(row_lengths(proposed - person.labels)) < 2
    views = read_json(out / "result.json")["views"]
    assert sum(view["proposed"] for view in views) > 20
    masks = read_masks(out, cameras)
    assert min(mask.sum() for mask in masks) > 100
    labels = out / "proposed_labels.json"
    succeeded(run(inputs, tmp_path / "again", "--labels", labels, "--masks", out))
    assert all(view["mask"] for view in read_json(tmp_path / "again" / "result.json")["views"])


def test_a_folder_without_the_cameras_photographs_is_refused(inputs, tmp_path):
    made = run(inputs, tmp_path / "out", "--pictures", tmp_path)
    assert "holds none of" in usage_error(made)
    assert not (tmp_path / "out" / "registered.npz").exists()
