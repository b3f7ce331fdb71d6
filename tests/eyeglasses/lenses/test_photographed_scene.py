"""Colours looked up in photographs: what is hidden is known to be, and guessed as declared."""

import numpy as np
import pytest
from helpers.plates import FACES, plate
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.eyeglasses.lenses.scene_colors import PhotographedScene
from scan2albedo.eyeglasses.lenses.scenes import LensScene, Surface
from scan2albedo.geometry.mesh import join, normalized
from scan2albedo.geometry.pinhole import look_at, project
from scan2albedo.geometry.rasterization import bilinear

SHAPE = (120, 160)
CAMERA = look_at([0, 0, 600], [0, 0, 0], focal_px=600, shape=SHAPE)
WHOLE = (slice(None), slice(None))


def sheet(x, y, z):
    (left, right), (low, high) = x, y
    return np.array([[left, low, z], [right, low, z], [right, high, z], [left, high, z]])


FRAME = Surface(sheet((30, 40), (-10, 10), 20.0), FACES, (0, 0, 0))
RISING = np.tile(np.arange(160.0)[:, None] / 160, (120, 1, 3))
"""A photograph whose brightness rises from left to right, so that a colour tells where it was taken."""


def photographed(*surfaces):
    scene = LensScene(FRAME, surfaces)
    return scene, PhotographedScene(scene, RISING, CAMERA, region=WHOLE)


@pytest.fixture
def two_sheets():
    """One surface: a wall, and a strip of it that stands 40 mm before it; albedo 0.2 and 0.8."""
    sheets = (sheet((-60, 60), (-70, 70), -30.0), FACES), (sheet((-10, 10), (-70, 70), 10.0), FACES)
    return photographed(Surface(*join(sheets), np.repeat([0.2, 0.8], 12).reshape(8, 3)))


def toward(scene, points, origin=(55.0, 0, 40)):
    """Rays from a point of a lens to points (N, 3)."""
    return scene.rays(np.tile(origin, (len(points), 1)), normalized(points - np.array(origin)))


def test_points_that_the_camera_saw_have_their_pixels_colour(two_sheets):
    scene, photograph = two_sheets
    points = np.array([[50.0, 5, -30], [20, -20, -30], [-5, 3, 10], [55, 40, -30]])
    seen = photograph.seen(toward(scene, points))
    assert not seen.unknown.any()
    pixels, _ = project(CAMERA, points)
    assert_allclose(seen.bare, bilinear(RISING, pixels), atol=1e-9)


def test_what_stands_behind_the_same_surface_is_hidden(two_sheets):
    scene, photograph = two_sheets
    # Seen from the side, past the strip; the camera sees the strip there.
    points = np.array([[0.0, 0, -30], [5, 10, -30]])
    seen = photograph.seen(toward(scene, points, origin=(0.0, 0, -10)))
    assert seen.unknown.all()
    # The nearest point of the wall in view lies just beside the strip.
    edge = project(CAMERA, np.array([[10 * 630 / 590, 0, -30]]))[0][0, 0]
    assert_allclose(np.abs(seen.bare[:, 0] * 160 - 79.5), edge - 79.5, atol=1.1)


def test_the_frame_hides_what_is_behind_it_and_its_fringe(two_sheets):
    scene, photograph = two_sheets
    # Places on the wall beside the one where the frame's right edge is seen; a pixel is 1.05 mm there.
    points = np.array([[40 * 630 / 580 + beside, 0, -30] for beside in (-5, 0.21, 6.3)])
    seen = photograph.seen(toward(scene, points, origin=(60.0, 0, 0)))
    assert seen.unknown.tolist() == [True, True, False]


def test_points_outside_the_picture_or_behind_the_camera_are_unknown():
    back = plate(900, 900.0, albedo_linear=(0.3, 0.3, 0.3))
    scene, photograph = photographed(plate(900, -30.0), back)
    rays = toward(scene, np.array([[500.0, 0, -30], [0, 0, 900], [10, 0, -30]]))
    seen = photograph.seen(rays)
    assert seen.unknown.tolist() == [True, True, False]
    # Of a surface that the photograph does not show at all there is only the albedo.
    assert_allclose(seen.bare[1], 0.3)
    assert_array_equal(photograph.mirrored(rays).unknown, seen.unknown)


def test_a_background_that_is_hidden_comes_from_beside_the_lens(two_sheets):
    scene, photograph = two_sheets
    # Past the wall's edge, in a direction in which the camera sees the wall.
    origin = np.array([70.0, 0, -50])
    rays = toward(scene, origin + [[-0.05, 0, -1.0]], origin)
    assert rays.hits.face.tolist() == [-1]
    seen = photograph.seen(rays)
    assert seen.unknown.all()
    at = project(CAMERA, origin[None])[0][0, 0]
    assert_allclose(seen.bare[0, 0] * 160, at, atol=1.5)
    # In this direction, 72 px beside the middle, it sees the background.
    shown = photograph.seen(toward(scene, origin + [[0.12, 0, -1.0]], origin))
    assert not shown.unknown.any()
    assert_allclose(shown.bare[0] * 160, 79.5 + 72, atol=1e-6)
