"""Pictures of anyone's scan."""

import sys

import make_gallery
import numpy as np
import pytest
from helpers.records import files_in
from PIL import Image
from worlds.files import write_obj


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
