"""Photographs looked up at vertices: colours, hidden places, masks, tone, and pictures that are not use."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from scan2albedo.errors import ReflectanceError
from scan2albedo.geometry.pinhole import look_at, pixel_directions, pixel_grid, project
from scan2albedo.lighting.environment import distant_directions
from scan2albedo.reflectance import light_transfer, observe_photograph
from scan2albedo.reflectance.vertex_visibility import VertexVisibility

DIRECTIONS = distant_directions(3000)
HULL = ConvexHull(DIRECTIONS).simplices
HULL = np.where((np.linalg.det(DIRECTIONS[HULL]) > 0)[:, None], HULL, HULL[:, ::-1])  # outward
SHAPE, RADIUS, NEAR, NEAR_RADIUS = (240, 280), 80.0, np.array([30.0, 20.0, 150.0]), 20.0
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


def test_colours_are_those_of_the_surface_and_nothing_hidden_is_seen(image):
    found = observe_photograph(image, CAMERA, VERTICES, FACES, normals=NORMALS, gamma=1.0)
    seen = found.seen & HEAD
    assert np.abs(found.observed_linear[seen] - color(NORMALS[seen])).max() < 0.01
    assert np.isnan(found.observed_linear[~found.seen]).all()
    sight = VERTICES - [0, 0, 600.0]
    hidden = np.isfinite(hit(NEAR, NEAR_RADIUS, sight / np.linalg.norm(sight, axis=1, keepdims=True)))
    assert not (found.seen & HEAD & hidden).any()
    cosine = -np.einsum("vi,vi->v", NORMALS, sight) / np.linalg.norm(sight, axis=1)
    should = HEAD & ~hidden & (cosine > 0.1)
    assert seen.sum() > 0.85 * should.sum()


def test_without_a_margin_edges_spoil_colours(image, monkeypatch):
    monkeypatch.setattr(VertexVisibility.seen, "__defaults__", (0.0,))
    found = observe_photograph(image, CAMERA, VERTICES, FACES, normals=NORMALS, gamma=1.0)
    seen = found.seen & HEAD
    assert np.abs(found.observed_linear[seen] - color(NORMALS[seen])).max() > 0.1


def test_tone_and_integers(image):
    displayed = image ** (1 / 1.2)
    found = [
        observe_photograph(picture, CAMERA, VERTICES, FACES)
        for picture in (
            displayed,
            np.round(255 * displayed).astype(np.uint8),
            np.round(65535 * displayed).astype(np.uint16),
        )
    ]
    plain = observe_photograph(image, CAMERA, VERTICES, FACES, gamma=1.0)
    for one, tolerance in zip(found, (1e-3, 4e-3, 1e-3), strict=True):
        np.testing.assert_array_equal(one.seen, plain.seen)
        np.testing.assert_allclose(
            one.observed_linear[one.seen], plain.observed_linear[one.seen], atol=tolerance
        )


def test_only_skin_counts_and_neither_saturated_nor_missing_pixels(image):
    mask = np.ones(SHAPE, bool)
    mask[:, :120] = False
    spoilt = image.copy()
    spoilt[:100, :, 1] = 0.99
    spoilt[180:, :, 2] = np.nan
    found = observe_photograph(spoilt, CAMERA, VERTICES, FACES, mask=mask, gamma=1.0)
    pixels, _ = project(CAMERA, VERTICES)
    assert found.seen.any()
    assert (pixels[found.seen, 0] >= 120).all()
    assert (pixels[found.seen, 1] >= 100).all()
    assert (pixels[found.seen, 1] <= 179).all()


def test_the_transfer_is_that_of_the_mesh(image):
    found = observe_photograph(image, CAMERA, VERTICES, FACES, gamma=1.0)
    normals, view = np.asarray(found.normals), np.asarray(found.toward_camera)
    expected = light_transfer(VERTICES, FACES, normals, view)
    np.testing.assert_array_equal(found.transfer.diffuse, expected.diffuse)
    np.testing.assert_array_equal(found.transfer.specular, expected.specular)


def test_pictures_of_32_bit_integers_are_refused(image):
    with pytest.raises(ReflectanceError, match="int32"):
        observe_photograph(image.astype(np.int32), CAMERA, VERTICES, FACES, gamma=1.0)


def test_all_vertices_hidden_or_off_the_mask_or_outside_the_picture(image):
    wall = np.array([[-900.0, -900, 590], [900, -900, 590], [0, 1500, 590]])
    vertices, faces = np.vstack([VERTICES, wall]), np.vstack([FACES, len(VERTICES) + np.arange(3)[None]])
    normals = np.vstack([NORMALS, np.zeros((3, 3))])
    with pytest.raises(ReflectanceError, match="0 are seen by the camera"):
        observe_photograph(image, CAMERA, vertices, faces, normals=normals, gamma=1.0)
    with pytest.raises(ReflectanceError, match="0 on the mask"):
        observe_photograph(image, CAMERA, VERTICES, FACES, mask=np.zeros(SHAPE, bool), gamma=1.0)
    beside = look_at([0, 0, 600], [0, 0, 0], focal_px=600, shape=(240, 3000))
    with pytest.raises(ReflectanceError, match="0 inside the picture"):
        observe_photograph(image, beside, VERTICES, FACES, gamma=1.0)
    away = look_at([0, 0, 600], [0, 0, 900], focal_px=600, shape=SHAPE)
    with pytest.raises(ReflectanceError, match="check camera"):
        observe_photograph(image, away, VERTICES, FACES, gamma=1.0)


def test_shapes_and_options_are_checked(image):
    with pytest.raises(ValueError, match="mask"):
        observe_photograph(image, CAMERA, VERTICES, FACES, mask=np.ones(SHAPE))
    with pytest.raises(ValueError, match="image"):
        observe_photograph(image[..., 0], CAMERA, VERTICES, FACES)
    with pytest.raises(ValueError, match="camera"):
        observe_photograph(image, CAMERA[:, :3], VERTICES, FACES)
    with pytest.raises(ReflectanceError, match="camera cannot be used"):
        observe_photograph(image, CAMERA * np.nan, VERTICES, FACES)
    with pytest.raises(ReflectanceError, match="its vertices have shape"):
        observe_photograph(image, CAMERA, VERTICES[:, :2], FACES)
    for name in ("gamma", "saturation"):
        with pytest.raises(ValueError, match=rf"{name} (is )?0,?"):
            observe_photograph(image, CAMERA, VERTICES, FACES, **{name: 0})
