"""Raw scans of the traced set: cameras, pixels, exposure; nothing is traced here."""

import numpy as np
import pytest
from helpers.square import SQUARE_FACES
from numpy.testing import assert_allclose, assert_array_equal
from worlds.files import write_obj
from worlds.path_tracer import exposure_of, stored
from worlds.pictures import filled, pods_around, used_pixels
from worlds.traced_charts import best_views
from worlds.traced_scans import truth_uv

import scan2albedo as s2a
from scan2albedo.geometry.pinhole import project
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.synthetic.raw_scan import capture
from scan2albedo.synthetic.renderer import toward
from scan2albedo.synthetic.sitter import join, sit_down


@pytest.fixture(scope="module")
def sitter():
    return sit_down(5, expression="neutral", model=s2a.AnnotatedFaceModel.default())


def test_light_of_untraced_pixels_is_that_of_the_nearest_one_in_the_same_picture():
    light = np.arange(2 * 4 * 3, dtype=float).reshape(8, 3)
    known = np.array([True, False, False, False, False, False, False, True])
    full = filled(light, known, 2, 2)
    assert_array_equal(full, np.broadcast_to(light[[0, 7], None, None], (2, 2, 2, 3)))


def test_pixels_of_the_scan_are_marked_and_the_background_is_not(sitter):
    pods = pods_around(np.array([0.0, -10.0, -20.0]), 3)
    measured = capture(
        sitter.vertices,
        sitter.faces,
        pods,
        spacing_mm=6.0,
        rng=np.random.default_rng(0),
        axis_mm=np.array([0.0, 0.0, -60.0]),
    )
    assert set(measured.face_pod) == {0, 1, 2}
    used = used_pixels(measured, pods, 64).reshape(3, 64, 64)
    assert not used[:, 0, [0, -1]].any()
    assert (used.mean((1, 2)) > 0.02).all()
    # The middle of the first picture shows the nose.
    assert used[0, 28:36, 30:34].all()


def test_the_truth_of_a_face_lies_where_a_camera_shows_it(sitter):
    pods = pods_around(np.array([0.0, -10.0, -20.0]), 2)
    uv = truth_uv(sitter, pods)
    shown = ~(uv == [0.0, 1.0]).all((1, 2))
    assert 0.2 < shown.mean() < 0.95
    pod = (uv[shown, 0, 0] > 0.5).astype(int)
    corner = sitter.vertices[sitter.faces[shown, 0]]
    place = np.where(pod[:, None] == 0, *(project(camera, corner)[0] for camera in pods))
    assert_allclose(uv[shown, 0, 0], (place[:, 0] + pod) / 2)
    assert_allclose(uv[shown, 0, 1], place[:, 1])


def test_the_best_free_view_is_taken_and_hidden_points_have_none():
    # A floor under a small roof.
    plate = np.array([[-1.0, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]])
    shapes = RayCaster(*join([(9 * plate, SQUARE_FACES), (2 * plate + [0, 1, 0], SQUARE_FACES)]))
    cameras = np.array([1000.0 * toward(0.0, elevation) for elevation in (89.9, 30.0)])
    points, up = np.array([[8.0, 0, 0], [0, 0, 0], [0, 0, 1.5]]), np.tile([0.0, 1, 0], (3, 1))
    camera, direction = best_views(points, up, shapes, cameras)
    assert camera.tolist() == [0, -1, 1]
    assert_allclose(np.linalg.norm(direction, axis=1), [1, 0, 1])


def test_exposure_leaves_two_in_a_hundred_texels_above_its_level():
    radiance = np.repeat(np.linspace(0, 5, 1000)[:, None], 3, 1)
    assert (exposure_of(radiance) * radiance[:, 0] > 0.8).mean() == pytest.approx(0.02, abs=0.002)


def test_the_camera_keeps_eight_bits_and_its_noise_follows_the_light():
    rng = np.random.default_rng(0)
    dark, bright = (stored(np.full((20000, 3), light), rng) for light in (0.04, 0.64))
    assert dark.std() == pytest.approx(0.008 * 0.2, rel=0.15)
    assert bright.std() == pytest.approx(0.008 * 0.8, rel=0.1)
    assert len(np.unique(bright)) < 30


def test_scans_in_metres_keep_their_detail(tmp_path):
    white = np.ones((2, 2, 3), np.float32)
    scan = s2a.RawScan(0.1234567 * np.eye(3), [[0, 1, 2]], uv=np.zeros((1, 3, 2)), texture_linear=white)
    write_obj(scan, tmp_path / "small.obj", decimals=7)
    assert "v 0.1234567 " in (tmp_path / "small.obj").read_text()
