"""Colours looked up in photographs: what is hidden is known to be, and guessed as declared."""

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.eyeglasses.lenses.scene_colors import PhotographedScene
from scan2albedo.eyeglasses.lenses.scenes import LensScene, Surface
from scan2albedo.geometry.pinhole import look_at, project
from scan2albedo.geometry.rasterization import bilinear

SHAPE = (120, 160)
CAMERA = look_at([0, 0, 600], [0, 0, 0], focal_px=600, shape=SHAPE)
WHOLE = (slice(None), slice(None))


def sheet(x, y, z):
    return np.array([[x[0], y[0], z], [x[1], y[0], z], [x[1], y[1], z], [x[0], y[1], z]])


def two_sheets():
    """One surface: a wall, and a strip of it that stands 40 mm before it; albedo 0.2 and 0.8."""
    corners = np.concatenate([sheet((-60, 60), (-70, 70), -30.0), sheet((-10, 10), (-70, 70), 10.0)])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    albedo = np.repeat([[0.2] * 3, [0.8] * 3], 4, 0)
    return Surface(corners, np.concatenate([faces, faces + 4]), albedo)


def frame():
    return Surface(sheet((30, 40), (-10, 10), 20.0), [[0, 1, 2], [0, 2, 3]], (0, 0, 0))


def photograph():
    """Brightness rises from left to right, so that a colour tells where it was taken."""
    return np.repeat(np.tile(np.arange(160.0) / 160, (120, 1))[..., None], 3, 2)


def scene_of():
    scene = LensScene(frame(), [two_sheets()])
    return scene, PhotographedScene(scene, photograph(), CAMERA, region=WHOLE)


def toward(scene, points, origin=(55.0, 0, 40)):
    """Rays from a point of a lens to points (N, 3)."""
    origins = np.tile(origin, (len(points), 1))
    directions = points - origins
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    return scene.rays(origins, directions)


def test_points_that_the_camera_saw_have_their_pixels_colour():
    scene, photographed = scene_of()
    points = np.array([[50.0, 5, -30], [20, -20, -30], [-5, 3, 10], [55, 40, -30]])
    seen = photographed.seen(toward(scene, points))
    assert not seen.unknown.any()
    pixels, _ = project(CAMERA, points)
    assert_allclose(seen.bare, bilinear(photograph(), pixels), atol=1e-9)


def test_what_stands_behind_the_same_surface_is_hidden():
    scene, photographed = scene_of()
    # Seen from the side, past the strip; the camera sees the strip there.
    points = np.array([[0.0, 0, -30], [5, 10, -30]])
    rays = toward(scene, points, origin=(0.0, 0, -10))
    seen = photographed.seen(rays)
    assert seen.unknown.all()
    # The nearest point of the wall in view lies just beside the strip.
    edge = project(CAMERA, np.array([[10 * 630 / 590, 0, -30]]))[0][0, 0]
    assert_allclose(np.abs(seen.bare[:, 0] * 160 - 79.5), edge - 79.5, atol=1.1)


def test_the_frame_hides_what_is_behind_it_and_its_fringe():
    scene, photographed = scene_of()
    # Places on the wall where the frame's right edge is seen, and 0.2 and 6 px beside it.
    edge = 40 * 630 / 580
    pixel = 630 / 600
    points = np.array([[edge - 5, 0, -30], [edge + 0.2 * pixel, 0, -30], [edge + 6 * pixel, 0, -30]])
    seen = photographed.seen(toward(scene, points, origin=(60.0, 0, 0)))
    assert seen.unknown.tolist() == [True, True, False]


def test_points_outside_the_picture_or_behind_the_camera_are_unknown():
    big = Surface(sheet((-900, 900), (-900, 900), -30.0), [[0, 1, 2], [0, 2, 3]])
    back = Surface(sheet((-900, 900), (-900, 900), 900.0), [[0, 1, 2], [0, 2, 3]], (0.3, 0.3, 0.3))
    scene = LensScene(frame(), [big, back])
    photographed = PhotographedScene(scene, photograph(), CAMERA, region=WHOLE)
    rays = toward(scene, np.array([[500.0, 0, -30], [0, 0, 900], [10, 0, -30]]))
    seen = photographed.seen(rays)
    assert seen.unknown.tolist() == [True, True, False]
    # Of a surface that the photograph does not show at all there is only the albedo.
    assert_allclose(seen.bare[1], 0.3)
    assert_array_equal(photographed.mirrored(rays).unknown, seen.unknown)


def test_a_background_that_is_hidden_comes_from_beside_the_lens():
    scene, photographed = scene_of()
    # Past the wall's edge, in a direction in which the camera sees the wall.
    origin = np.array([[70.0, 0, -50]])
    direction = np.array([[-0.05, 0, -1.0]])
    direction /= np.linalg.norm(direction)
    rays = scene.rays(origin, direction)
    assert rays.hits.face.tolist() == [-1]
    seen = photographed.seen(rays)
    assert seen.unknown.all()
    at = project(CAMERA, origin)[0][0, 0]
    assert_allclose(seen.bare[0, 0] * 160, at, atol=1.5)
