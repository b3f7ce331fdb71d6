"""Photographs looked up at vertices: colours, hidden places, masks, tone, and pictures that are not use."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import ConvexHull

from scan2albedo.errors import ReflectanceError
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.pinhole import look_at, pixel_directions, pixel_grid, project
from scan2albedo.lighting.environment import distant_directions
from scan2albedo.reflectance import light_transfer, observe_photograph

DIRECTIONS = distant_directions(3000)
HULL = ConvexHull(DIRECTIONS).simplices
HULL = np.where((np.linalg.det(DIRECTIONS[HULL]) > 0)[:, None], HULL, HULL[:, ::-1])  # outward
SHAPE = (240, 280)
RADIUS = 80.0
NEAR = np.array([30.0, 20.0, 150.0])
NEAR_RADIUS = 20.0
CAMERA = look_at([0, 0, 600], [0, 0, 0], focal_px=600, shape=SHAPE)
VERTICES = np.vstack([RADIUS * DIRECTIONS, NEAR + NEAR_RADIUS * DIRECTIONS])
FACES = np.vstack([HULL, HULL + len(DIRECTIONS)])
NORMALS = np.vstack([DIRECTIONS, DIRECTIONS])
HEAD = np.arange(len(VERTICES)) < len(DIRECTIONS)


def hit(centre, radius, along):
    """Distance from the camera at which rays meet a ball; inf where they do not."""
    toward = centre - [0, 0, 600.0]
    middle = along @ toward
    inside = radius**2 - (toward @ toward - middle**2)
    return np.where(inside > 0, middle - np.sqrt(np.maximum(inside, 0)), np.inf)


def color(normals):
    return 0.3 + normals @ np.array([[0.1, 0.02, 0.0], [0.0, 0.12, 0.0], [0.05, 0.0, 0.1]])


@pytest.fixture(scope="module")
def image():
    """A small white ball before a big one whose colour follows its normal, before black."""
    along = pixel_directions(CAMERA, pixel_grid(SHAPE))
    far, near = hit(np.zeros(3), RADIUS, along), hit(NEAR, NEAR_RADIUS, along)
    normals = ([0, 0, 600.0] + np.where(np.isfinite(far), far, 0)[:, None] * along) / RADIUS
    picture = np.where(np.isfinite(far)[:, None], color(normals), 0.0)
    return np.where((near < far)[:, None], 0.9, picture).reshape(*SHAPE, 3)


def observe(image, camera=CAMERA, vertices=VERTICES, faces=FACES, **options):
    return observe_photograph(image, camera, vertices, faces, **{"gamma": 1.0, **options})


def test_colours_are_those_of_the_surface_and_nothing_hidden_is_seen(image):
    found = observe(image, normals=NORMALS)
    seen = found.seen & HEAD
    assert np.abs(found.observed_linear[seen] - color(NORMALS[seen])).max() < 0.01
    assert np.isnan(found.observed_linear[~found.seen]).all()
    sight = normalized(VERTICES - [0, 0, 600.0])
    hidden = np.isfinite(hit(NEAR, NEAR_RADIUS, sight))
    assert not (found.seen & HEAD & hidden).any()
    cosine = -np.einsum("vi,vi->v", NORMALS, sight)
    should = HEAD & ~hidden & (cosine > 0.1)
    assert seen.sum() > 0.85 * should.sum()


def test_tone_and_integers(image):
    displayed = image ** (1 / 1.2)
    eight, sixteen = np.round(255 * displayed), np.round(65535 * displayed)
    plain = observe(image)
    for picture, tolerance in (
        (displayed, 1e-3),
        (eight.astype(np.uint8), 4e-3),
        (sixteen.astype(np.uint16), 1e-3),
    ):
        one = observe(picture, gamma=1.2)
        assert_array_equal(one.seen, plain.seen)
        assert_allclose(one.observed_linear[one.seen], plain.observed_linear[one.seen], atol=tolerance)


def test_only_skin_counts_and_neither_saturated_nor_missing_pixels(image):
    mask = np.ones(SHAPE, bool)
    mask[:, :120] = False
    spoilt = image.copy()
    spoilt[:100, :, 1] = 0.99
    spoilt[180:, :, 2] = np.nan
    found = observe(spoilt, mask=mask)
    pixels, _ = project(CAMERA, VERTICES)
    column, row = pixels[found.seen].T
    assert column.min() >= 120
    assert row.min() >= 100
    assert row.max() <= 179


def test_the_transfer_is_that_of_the_mesh(image):
    found = observe(image)
    normals, view = np.asarray(found.normals), np.asarray(found.toward_camera)
    expected = light_transfer(VERTICES, FACES, normals, view)
    assert_array_equal(found.transfer.diffuse, expected.diffuse)
    assert_array_equal(found.transfer.specular, expected.specular)


WALL = np.array([[-900.0, -900, 590], [900, -900, 590], [0, 1500, 590]])
BEHIND_A_WALL = {
    "vertices": np.vstack([VERTICES, WALL]),
    "faces": np.vstack([FACES, len(VERTICES) + np.arange(3)[None]]),
    "normals": np.vstack([NORMALS, np.zeros((3, 3))]),
}
BESIDE = look_at([0, 0, 600], [0, 0, 0], focal_px=600, shape=(240, 3000))
AWAY = look_at([0, 0, 600], [0, 0, 900], focal_px=600, shape=SHAPE)


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        (BEHIND_A_WALL, ReflectanceError, "0 are seen by the camera"),
        ({"mask": np.zeros(SHAPE, bool)}, ReflectanceError, "0 on the mask"),
        ({"camera": BESIDE}, ReflectanceError, "0 inside the picture"),
        ({"camera": AWAY}, ReflectanceError, "check camera"),
        ({"image": np.ones((*SHAPE, 3), np.int32)}, ReflectanceError, "int32"),
        ({"camera": CAMERA * np.nan}, ReflectanceError, "camera cannot be used"),
        ({"vertices": VERTICES[:, :2]}, ReflectanceError, "its vertices have shape"),
        ({"mask": np.ones(SHAPE)}, ValueError, "mask"),
        ({"image": np.ones(SHAPE)}, ValueError, "image"),
        ({"camera": CAMERA[:, :3]}, ValueError, "camera"),
        ({"gamma": 0}, ValueError, "gamma is 0"),
        ({"saturation": 0}, ValueError, "saturation is 0"),
    ],
)
def test_what_shows_no_face_is_refused(image, changes, error, words):
    with pytest.raises(error, match=words):
        observe(**({"image": image} | changes))
