"""Frames registered by the command from photographs alone."""

import numpy as np
import pytest
from helpers.cli import invoke
from helpers.commands import succeeded
from helpers.records import read_json
from helpers.usage import usage_error
from helpers.wearers import small_wearer
from scipy.ndimage import gaussian_filter

from scan2albedo.eyeglasses import read_cameras, read_labels, read_masks, read_registered
from scan2albedo.io.images import write_png
from scan2albedo.runs.eyeglasses.demo import write_wearer

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def person():
    return small_wearer(1, 512)


@pytest.fixture(scope="module")
def inputs(person, tmp_path_factory):
    """A folder with the wearer's files, and photographs of a dark frame before mottled skin."""
    out = tmp_path_factory.mktemp("wearer")
    write_wearer(person, (person.head_vertices, person.head_faces), out)
    rng, folder = np.random.default_rng(0), out / "input" / "photographs"
    folder.mkdir()
    for camera, mask in zip(read_cameras(out / "input" / "cameras.json"), person.masks, strict=True):
        skin = np.array([180.0, 130, 110]) * (
            1 + 1.5 * gaussian_filter(rng.normal(size=mask.shape), 4)[..., None]
        )
        shown = gaussian_filter(np.where(mask[..., None], [40.0, 35, 38], skin), (0.7, 0.7, 0))
        noisy = shown + rng.normal(0, 4, skin.shape)
        write_png(folder / f"{camera.name}.png", np.clip(noisy, 0, 255).astype(np.uint8))
    return out / "input"


def run(folder, out, *more):
    arguments = [folder / "frame.obj", "-o", out, "--cameras", folder / "cameras.json", *more]
    return invoke("glasses", "register", *arguments)


def test_photographs_alone_place_a_frame_and_give_labels_to_correct(person, inputs, tmp_path):
    out = tmp_path / "out"
    succeeded(run(inputs, out, "--pictures", inputs / "photographs", "--head", inputs / "head.glb"))
    off = np.linalg.norm(read_registered(out / "registered.npz").vertices - person.vertices, axis=1)
    front = person.glasses.rest_vertices[:, 2] > person.glasses.rest_keypoints[:, 2].max() - 20
    assert np.sqrt((off[front] ** 2).mean()) < 1
    cameras = read_cameras(inputs / "cameras.json")
    names = [camera.name for camera in cameras]
    proposed = read_labels(out / "proposed_labels.json").of_cameras(names)
    far = np.linalg.norm(proposed - person.labels, axis=2)
    assert np.nanmedian(far) < 2
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
