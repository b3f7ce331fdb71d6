"""A face that its pictures showed in part: the rest is filled and marked, and nothing follows from it."""

import numpy as np
import pytest
from PIL import Image, ImageDraw

from scan2albedo import load_scan, process

SIZE = 128
HOLE_MM = 24.0


@pytest.fixture(scope="module")
def unpainted(shared_data, tmp_path_factory):
    """Folder with james.obj, whole and with a cheek that is transparent, orange or black in its texture."""
    folder = tmp_path_factory.mktemp("unpainted")
    text = (shared_data / "james.obj").read_text().splitlines()
    lines = [line for line in text if line[:2] in ("v ", "vt", "f ")]
    scan = load_scan(shared_data / "james.obj", unit="mm")
    picked = np.loadtxt(shared_data / "james_ibug68.csv", delimiter=",")
    middle = 0.45 * picked[2] + 0.55 * picked[31]
    image = Image.open(shared_data / "james.jpg").convert("RGB")
    image.thumbnail((1024, 1024))
    alpha = Image.new("L", image.size, 255)
    draw = ImageDraw.Draw(alpha)
    inside = (np.linalg.norm(scan.vertices[scan.faces] - middle, axis=-1) < HOLE_MM).all(1)
    for place in scan.uv[inside]:
        draw.polygon([(u * image.width, (1 - v) * image.height) for u, v in place], fill=0)
    pixels, shown = np.asarray(image), np.asarray(alpha)
    empty = shown[..., None] == 0
    pictures = {
        "plain": pixels,
        "transparent": np.dstack([np.where(empty, 0, pixels), shown]).astype(np.uint8),
        "orange": np.where(empty, np.uint8([255, 127, 39]), pixels),
        "black": np.where(empty, np.uint8(0), pixels),
    }
    for name, picture in pictures.items():
        Image.fromarray(picture).save(folder / f"{name}.png")
        (folder / f"{name}.mtl").write_text(f"newmtl skin\nmap_Kd {name}.png\n")
        (folder / f"{name}.obj").write_text("\n".join([f"mtllib {name}.mtl", "usemtl skin", *lines]))
    return folder


@pytest.fixture(scope="module")
def plain(unpainted):
    """The result of the whole texture."""
    return process(unpainted / "plain.obj", size=SIZE, quality="draft", skip=("albedo",))


def test_a_whole_texture_is_seen_everywhere(plain):
    assert plain.scan.color_seen is None
    assert plain.geometry_image.filled is None
    assert not any(step.stage == "geometry_image.filled" for step in plain.plan.steps)


@pytest.mark.parametrize("name", ["transparent", "orange", "black"])
def test_what_no_picture_showed_is_filled_and_marked(unpainted, plain, name):
    result = process(unpainted / f"{name}.obj", size=SIZE, quality="draft", skip=("albedo",))
    image, filled = result.geometry_image, result.geometry_image.filled
    assert 100 < filled.sum() < 400
    assert not image.seen[filled].any()
    assert image.skin[filled].max() == 0
    (doubt,) = result.plan.doubts().of_stage("geometry_image.filled")
    assert "no picture showed 1." in doubt.reason
    apart = np.linalg.norm(result.fitted.landmarks - plain.fitted.landmarks, axis=1)
    assert apart.max() < 0.3


@pytest.mark.slow
def test_light_and_albedo_do_not_see_what_fills_the_hole(unpainted):
    names = "plain", "orange", "black"
    whole, orange, black = (process(unpainted / f"{name}.obj", size=2 * SIZE) for name in names)
    filled, seen = orange.geometry_image.filled, orange.geometry_image.seen
    assert orange.albedo.confidence[filled].max() == 0
    np.testing.assert_allclose(orange.albedo.albedo_linear[seen], black.albedo.albedo_linear[seen], atol=1e-4)
    # A cheek less is another picture: two lamps that explain it about as well may change places, so that not
    # their directions are compared but what their light leaves, which has one factor that nobody knows.
    ratio = orange.albedo.albedo_linear / np.maximum(whole.albedo.albedo_linear, 1e-4)
    both = seen & whole.geometry_image.seen
    factor = np.median(ratio[both])
    assert np.median(np.abs(ratio[both] / factor - 1)) < 0.04
    inside = filled & whole.geometry_image.seen
    assert np.median(np.abs(ratio[inside] / factor - 1)) < 0.15
