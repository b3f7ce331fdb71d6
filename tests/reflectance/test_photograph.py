"""Photographs looked up at vertices: colours, hidden places, masks, tone, and pictures that are not use."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from worlds.two_balls import BALL, BALL_RADIUS, ROOM, SHAPE, first_hit, radiance_at, unit

from scan2albedo.errors import ReflectanceError
from scan2albedo.geometry.pinhole import look_at, project
from scan2albedo.reflectance import light_transfer, observe_photograph

FRONT = 9
"""The picture of the scene whose flash stands at its camera before the face."""


@pytest.fixture(scope="module")
def observe(scene):
    """`observe_photograph` of that picture, but for what is given."""
    given = {"image": scene.flash[FRONT], "camera": scene.rig.cameras[FRONT]}
    given |= {"vertices": scene.vertices, "faces": scene.faces}
    return lambda **changes: observe_photograph(**given | changes)


def test_colours_are_those_of_the_surface_and_nothing_hidden_is_seen(scene, observe):
    found = observe(normals=scene.normals)
    place = scene.rig.camera_positions[FRONT]
    seen = found.seen & scene.head
    expected = ROOM + radiance_at(scene.vertices, scene.normals, place, place)
    assert np.abs(found.observed_linear - expected)[seen].max() < 0.01
    assert np.isnan(found.observed_linear[~found.seen]).all()
    sight = unit(place - scene.vertices)
    hidden = np.isfinite(first_hit(scene.vertices, sight, BALL, BALL_RADIUS))
    assert not (seen & hidden).any()
    should = scene.head & ~hidden & ((scene.normals * sight).sum(1) > 0.1)
    assert seen.sum() > 0.83 * should.sum()


def test_tone_and_integers(scene, observe):
    displayed = scene.flash[FRONT]
    linear = observe(image=displayed**1.2, gamma=1.0)
    for picture, tolerance in (
        (displayed, 1e-3),
        (np.round(255 * displayed).astype(np.uint8), 4e-3),
        (np.round(65535 * displayed).astype(np.uint16), 1e-3),
    ):
        one = observe(image=picture, gamma=1.2)
        assert_array_equal(one.seen, linear.seen)
        assert_allclose(one.observed_linear[one.seen], linear.observed_linear[one.seen], atol=tolerance)


def test_only_skin_counts_and_neither_saturated_nor_missing_pixels(scene, observe):
    mask = np.ones(SHAPE, bool)
    mask[:, :70] = False
    spoilt = scene.flash[FRONT].copy()
    spoilt[:60, :, 1] = 0.99
    spoilt[120:, :, 2] = np.nan
    found = observe(image=spoilt, mask=mask)
    pixels, _ = project(scene.rig.cameras[FRONT], scene.vertices)
    column, row = pixels[found.seen].T
    assert column.min() >= 70
    assert row.min() >= 60
    assert row.max() <= 119


def test_the_transfer_is_that_of_the_mesh(scene, observe):
    found = observe()
    expected = light_transfer(scene.vertices, scene.faces, found.normals, found.toward_camera)
    assert_array_equal(found.transfer.diffuse, expected.diffuse)
    assert_array_equal(found.transfer.specular, expected.specular)


AWAY = look_at([0, 0, 900], [0, 0, 1200], focal_px=600, shape=SHAPE)


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"mask": np.zeros(SHAPE, bool)}, ReflectanceError, "0 on the mask"),
        (
            {"camera": AWAY},
            ReflectanceError,
            "check camera",
        ),
        ({"image": np.ones((*SHAPE, 3), np.int32)}, ReflectanceError, "int32"),
        ({"camera": np.full((3, 4), np.nan)}, ReflectanceError, "camera cannot be used"),
        ({"vertices": np.zeros((3, 2))}, ReflectanceError, "its vertices have shape"),
        ({"mask": np.ones(SHAPE)}, ValueError, "mask"),
        ({"image": np.ones(SHAPE)}, ValueError, "image"),
        ({"camera": np.eye(3)}, ValueError, "camera"),
        ({"gamma": 0}, ValueError, "gamma is 0"),
        ({"saturation": 0}, ValueError, "saturation is 0"),
    ],
)
def test_what_shows_no_face_is_refused(observe, changes, error, words):
    with pytest.raises(error, match=words):
        observe(**changes)
