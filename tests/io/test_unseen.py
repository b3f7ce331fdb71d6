"""Which colours of a scan a picture showed."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.meshes import grid, obj_text
from numpy.testing import assert_array_equal
from PIL import Image

from scan2albedo.io import load_scan
from scan2albedo.io.color import srgb_to_linear
from scan2albedo.io.texture_atlas import seen_colors

VERTICES, FACES = grid(41, 41)
"""Of a square of 40 x 40 cells, each two faces; its coordinates are those of its vertices."""
ORANGE = (255, 127, 39)


LEVEL = 120 + 60 * np.sin(np.arange(240) / 80)[:, None] + np.random.default_rng(0).normal(0, 3, (240, 240))
PIXELS = np.clip(LEVEL[..., None] * [1, 0.8, 0.7], 0, 255).astype(np.uint8)
"""A photograph of skin with noise."""
HOLE = np.zeros((240, 240), bool)
HOLE[60:120, 90:150] = True


def loaded(folder, image):
    """Write the square with a texture as OBJ and return the scan that is read."""
    image.save(folder / "skin.png")
    text = obj_text(160 * VERTICES, FACES, VERTICES[:, :2])
    (folder / "skin.obj").write_text(f"mtllib skin.mtl\nusemtl skin\n{text}")
    (folder / "skin.mtl").write_text("newmtl skin\nmap_Kd skin.png\n")
    return load_scan(folder / "skin.obj", unit="mm")


@pytest.mark.parametrize("fill", [ORANGE, (0, 0, 0), (128, 128, 128)])
def test_a_colour_that_was_filled_in_was_not_seen(tmp_path, fill):
    pixels = np.where(HOLE[..., None], np.uint8(fill), PIXELS)
    scan = loaded(tmp_path, Image.fromarray(pixels))
    assert scan.color_seen is not None
    assert not scan.color_seen[HOLE].any()
    assert scan.color_seen[~HOLE].mean() > 0.999
    assert scan.has_color


@pytest.mark.parametrize("kind", ["RGBA", "LA", "P"])
def test_what_is_transparent_was_not_seen(tmp_path, kind):
    image = Image.fromarray(np.dstack([PIXELS, np.where(HOLE, 0, 255).astype(np.uint8)]))
    if kind == "P":
        index = np.where(HOLE, 0, np.clip(PIXELS[..., 0], 1, 255)).astype(np.uint8)
        image = Image.fromarray(index, "L").convert("P")
        image.info["transparency"] = 0
    elif kind == "LA":
        image = image.convert("LA")
    assert_array_equal(loaded(tmp_path, image).color_seen, ~HOLE)


def test_an_alpha_that_is_alike_everywhere_says_nothing(tmp_path):
    for alpha in (0, 80, 255):
        rgba = np.dstack([PIXELS, np.full(PIXELS.shape[:2], alpha, np.uint8)])
        assert loaded(tmp_path, Image.fromarray(rgba)).color_seen is None


def test_photographs_and_clipped_white_were_seen():
    clipped = np.where(HOLE[..., None], np.uint8(255), PIXELS)
    # The last one is so coarse that most faces lie in one pixel.
    for shown in (PIXELS, clipped, clipped[::40, ::40]):
        linear = srgb_to_linear(shown / 255).astype(np.float32)
        assert seen_colors(linear, FACES, VERTICES[FACES][..., :2])[1] is None


def test_a_scan_of_one_colour_has_no_colour(tmp_path):
    scan = loaded(tmp_path, Image.new("RGB", (64, 64), "grey"))
    assert not scan.has_color
    assert any("say nothing" in note for note in scan.notes)
    assert scan.texture_linear.shape == (64, 64, 3)
    assert replace(scan, color_seen=None).has_color


def test_vertices_of_one_colour_were_not_seen():
    colors = np.random.default_rng(0).uniform(0.2, 0.6, VERTICES.shape).astype(np.float32)
    assert seen_colors(colors, FACES)[1] is None
    hole = np.linalg.norm(160 * VERTICES - [80, 80, 0], axis=1) < 30
    colors[hole] = 0.5
    assert_array_equal(seen_colors(colors, FACES)[1], ~hole)
    found, seen = seen_colors(np.column_stack([colors, ~hole]).astype(np.float32), FACES)
    assert_array_equal(found, colors)
    assert_array_equal(seen, ~hole)
