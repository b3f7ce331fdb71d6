"""What an unlit scan is beyond the face: skin without a step at the rim, and hair kept apart."""

import cv2
import numpy as np
import pytest
from helpers.faces import with_template
from helpers.meshes import grid
from helpers.records import read_json
from numpy.testing import assert_allclose

import scan2albedo as s2a
from scan2albedo.face_model.materials import CLASSES, MaterialModel, materials_beyond_chart
from scan2albedo.geometry.mesh import neighbour_mean
from scan2albedo.geometry.rasterization import interpolate, pixels_from_uv, rasterize
from scan2albedo.io.images import read_image_linear, read_image_values
from scan2albedo.unlit.light_removal import scan_on_chart, unlit_scan


@pytest.fixture(scope="module")
def result(shared_data, tmp_path_factory):
    """Of a path-traced head with black hair between a window and a lamp of another colour; the model's own
    control mesh is the template."""
    file, out = shared_data / "real_skin" / "d_window_lamp.obj", tmp_path_factory.mktemp("out")
    options = {"unlit": "all", "size": 256, "quality": "draft", "pictures": False, "texture_size": 256}
    return s2a.process(file, out, model=with_template(), **options)


@pytest.fixture(scope="module")
def texels(result, shared_data):
    """True log albedo of the texels (N, 3), their weight on the face, which they are, skin's usual log albedo
    on the face, and which texels (N,) are such skin."""
    scan = result.scan
    shape = scan.texture_linear.shape[:2]
    picture = read_image_linear(shared_data / "real_skin" / "d_window_lamp_albedo.png")
    true = cv2.resize(picture, shape[::-1], interpolation=cv2.INTER_LINEAR)
    corners = pixels_from_uv(scan.uv.reshape(-1, 2), shape)
    index = np.arange(len(corners)).reshape(-1, 3)
    raster = rasterize(corners, np.zeros(len(corners)), index, shape)
    own = scan_on_chart(scan, result.fitted, result.albedo.image)[1][scan.faces].reshape(-1, 1)
    light = scan.texture_linear.max(-1) / np.maximum(true.max(-1), 1e-3)
    there = raster.covered & (true.min(-1) > 0.01) & (light > 0.03 * np.median(light[raster.covered]))
    log_true, weight = np.log(true[there]), interpolate(raster, index, own)[there, 0]
    usual = np.median(log_true[weight > 0.99], axis=0)
    return log_true, weight, there, usual, np.abs(log_true - usual).max(-1) < 0.5


@pytest.mark.slow
def test_skin_beyond_the_face_has_the_faces_colour(result, texels):
    log_true, weight, there, _, skin = texels
    beyond, face = skin & (weight < 0.01), skin & (weight > 0.99)
    errors = {}
    of_face = unlit_scan(result.scan, result.fitted, result.albedo)
    for name, scan in (("lit", result.scan), ("face", of_face.scan), ("all", result.unlit.scan)):
        off = np.log(np.maximum(scan.texture_linear[there], 1e-4)) - log_true
        off -= np.median(off[face], axis=0)
        errors[name] = np.median(np.abs(off[beyond]).max(-1))
    assert errors["all"] < 0.3 < errors["face"] < 0.75 * errors["lit"]
    # The last one is that of `all`. There is no step across the rim.
    assert np.abs(np.median(off[skin & (weight < 0.05)], axis=0)).max() < 0.2
    # Misplaced outlines of shadows, on ears and neck, are gone.
    assert np.percentile(np.abs(off[beyond]).max(-1), 90) < 0.65
    # On the face nothing depends on what is done beyond, but for single texels whose noise is filtered.
    on_face = (one.texture_linear[there][weight > 0.999] for one in (of_face.scan, result.unlit.scan))
    assert np.isclose(*on_face, rtol=0.2, atol=0.02).mean() > 0.999


def test_hair_is_found_beyond_the_chart_and_skin_is_not_hair(result, texels):
    log_true, weight, there, usual, skin = texels
    beyond = weight < 0.01
    dark, hair = log_true.max(-1) < usual.max() - 1, result.unlit.hair[there] > 0.5
    assert (beyond & dark).sum() > 1000 < (beyond & skin).sum()
    assert hair[beyond & dark].mean() > 0.8
    assert hair[beyond & skin].mean() < 0.05


def test_hairs_file_holds_its_lit_colours_and_how_surely_it_is_hair(result):
    picture = read_image_values(result.out / "unlit_hair.png", alpha=True)
    assert_allclose(picture[..., 3] / 255, np.clip(result.unlit.hair, 0, 1), atol=0.003)
    lit = read_image_linear(result.out / "unlit_hair.png")
    assert_allclose(lit[..., :3], np.clip(result.scan.texture_linear, 0, 1), atol=0.01)
    assert "unlit_hair.png" in read_json(result.out / "result.json")["files"]
    assert result.plan.ran("unlit.hair")


def test_a_template_has_hair_of_its_own(result):
    (tile,) = result.template.tiles
    picture = read_image_values(result.out / "template_hair.png", alpha=True)
    assert_allclose(picture[..., 3] / 255, np.clip(tile.hair[..., 3], 0, 1), atol=0.003)
    # Its chart is the face's: brows are hair, cheeks are not, and hair has the scan's own colours.
    labels = result.geometry_image.labels
    brow, skin = (cv2.erode((labels == k).astype(np.uint8), np.ones((5, 5))) > 0 for k in (2, 1))
    assert np.mean(tile.hair[brow, 3] > 0.5) > 0.9
    assert np.mean(tile.hair[skin, 3] > 0.5) < 0.02
    lit = result.geometry_image.texture_linear
    assert np.abs(tile.hair[..., :3] - lit)[brow].mean() < 0.5 * np.abs(tile.color_linear - lit)[brow].mean()


def shares_of(far, direction, place, brighter=0.0):
    """Shares of the classes where colours differ from skin's by `far` (3,) beyond 4 of 8 cm, and where."""
    flat, faces = grid(21, 21)
    distance = 80 * flat[:, 1]
    offset, beyond = np.outer(distance, direction), distance >= 40
    color = np.random.default_rng(0).normal([-1.0, -1.5, -1.8], 0.02, offset.shape) + brighter
    color += np.outer(beyond, far)
    normal, places = 0 * offset + [0, 0, 1], np.tile(place, (len(flat), 1))
    mean, skin = neighbour_mean(len(flat), faces), (distance < 20) * 1.0
    return materials_beyond_chart(color, normal, skin, places, offset, mean, 4.0), beyond


def test_dark_is_hair_above_the_forehead_and_white_is_cloth_below_the_chin():
    hair, cloth = CLASSES.index("hair") - 1, CLASSES.index("cloth") - 1
    dark = [-2.2, -1.8, -1.5], (0, 1, 0), (0.02, 0.5)
    found, beyond = shares_of(*dark)
    assert found.shape == (len(MaterialModel.default().share), len(beyond))
    assert_allclose(found.sum(0), 1)
    assert np.median(found[hair, beyond]) > 0.9
    assert np.median(found[0, ~beyond]) > 0.9
    # The exposure of the scan decides nothing.
    assert_allclose(shares_of(*dark, brighter=-1.3)[0], found, atol=0.02)
    found, beyond = shares_of([0.7, 1.2, 1.5], (0, -1, 0), (0.98, 0.5))
    assert np.median(found[cloth, beyond]) > 0.9
    even, _ = shares_of([0, 0, 0], (0, 1, 0), (0.02, 0.5))
    assert even[0].min() > 0.9
