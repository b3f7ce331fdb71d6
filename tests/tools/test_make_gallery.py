"""Pictures of anyone's scan."""

import sys

import make_gallery
import numpy as np
import pytest
from helpers.records import files_in
from PIL import Image
from worlds.files import write_obj

from scan2albedo.face_model import default_model
from scan2albedo.io.linear_model_files import LinearFaceModel


@pytest.mark.slow
def test_a_scan_is_shown_beside_itself_without_its_light(coarse_scan, tmp_path, monkeypatch):
    write_obj(coarse_scan[0], tmp_path / "subject.obj")
    asked = ["make_gallery", "--scan", str(tmp_path / "subject.obj"), "-o", str(tmp_path / "out")]
    monkeypatch.setattr(sys, "argv", asked)
    make_gallery.main()
    assert files_in(tmp_path / "out") == {"scan.jpg", "unlit.jpg", "maps.jpg"}
    with Image.open(tmp_path / "out" / "unlit.jpg") as picture:
        pixels = np.asarray(picture.convert("RGB"), float)
    # Four panels, each with a face on white.
    for panel in np.array_split(pixels[: make_gallery.HEIGHT], 4, axis=1):
        assert 0.2 < (panel.min(-1) < 240).mean() < 0.95


def test_the_jaw_of_the_synthetic_model_parts_the_lips(tmp_path):
    make_gallery.write_linear_model(tmp_path / "people.npz")
    linear, model = LinearFaceModel.load(tmp_path / "people.npz"), default_model()
    fine = model.subdivision(3)
    upper, lower = (
        np.unique(fine.faces[model.region[fine.parent] == model.regions[name].index])
        for name in ("upper_lip", "lower_lip")
    )
    middle = np.abs(linear.mean[:, 0]) < 5
    coefficients = np.zeros(linear.components)
    coefficients[linear.shapes + linear.names.index("jawOpen")] = 1
    down = linear.mean[:, 1] - linear.at(coefficients)[:, 1]
    jaw = -make_gallery.JAW_MM[1]
    assert down[upper[middle[upper]]].max() < 0.1 * jaw
    assert down[lower[middle[lower]]].min() > 0.9 * jaw
    assert np.abs(down[linear.mean[:, 1] > 20]).max() < 0.1 * jaw
    # Nothing but the corners of the mouth holds the lips together.
    joined = linear.faces[np.isin(linear.faces, upper).any(1) & np.isin(linear.faces, lower).any(1)]
    assert np.abs(linear.mean[joined, 0]).min(initial=np.inf) > 15


@pytest.mark.slow
def test_proposed_key_points_are_drawn_with_their_deviations():
    pixels = np.asarray(make_gallery.key_points_picture(), float)
    red = (pixels[..., 0] > 150) & (pixels[..., 1:].max(-1) < 90)
    assert red.sum() > 20 * 10
    assert pixels.shape[1] < 1000


@pytest.mark.parametrize("name", ["eyes_and_mouth", "blendshapes", "key_points"])
def test_pictures_of_the_gallery_are_small(name):
    file = make_gallery.OUT / f"{name}.jpg"
    assert file.stat().st_size < 80_000
