"""Thin lenses against constructions that know nothing of the formula: conjugate points, focal rays."""

import numpy as np
import pytest
from helpers.eyeglasses import angle_deg, conjugate_directions
from numpy.testing import assert_allclose

from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.lenses.optics import ThinLens, refract
from scan2albedo.geometry.rigid import random_rotation


def thin(dioptres):
    return ThinLens(np.zeros(3), [0, 0, 1], dioptres)


def lens_points(rng, count=200):
    return np.column_stack([rng.uniform(-28, 28, (count, 2)), np.zeros(count)])


def test_rays_meet_the_conjugate_image():
    points = lens_points(np.random.default_rng(0))
    for dioptres in (-8, -4, -2, -0.25, 0.25, 1, 2.1, 4, 8):
        for camera in ([30.0, -60, 600], [-200, 90, 350], [5, 3, 1500], [1, 1, 40]):
            got = refract(thin(dioptres), camera, points).directions
            image = conjugate_directions(np.array(camera), points, np.zeros(3), np.eye(3)[2], dioptres)
            assert angle_deg(got, image).max() <= 1e-5


def test_nothing_is_lost_within_20_dioptres_at_the_poles_of_the_usual_formula():
    points = lens_points(np.random.default_rng(1))
    for dioptres in [*np.linspace(-20, 20, 161), 1e-12, -1e-12, 5e-324]:
        # The last distances make 1 + u P zero or nearly so.
        pole = 1000 / dioptres if dioptres > 1e-3 else 500.0
        for distance in (20.0, 600.0, 1e5, pole, np.nextafter(pole, 0), np.nextafter(pole, 1e9)):
            with np.errstate(all="raise", under="ignore"):
                rays = refract(thin(dioptres), [7.0, -4, distance], points)
            assert_allclose(np.linalg.norm(rays.directions, axis=1), 1, atol=1e-14)
            assert (rays.directions[:, 2] < 0).all()


def test_plane_glass_leaves_rays_alone_and_the_collimated_ones_are_parallel():
    points = lens_points(np.random.default_rng(2))
    camera = np.array([40.0, 10, 500])
    assert angle_deg(refract(thin(0.0), camera, points).directions, points - camera).max() < 1e-12
    parallel = refract(thin(2.0), camera, points).directions
    assert angle_deg(parallel, np.tile(-camera, (len(points), 1))).max() < 1e-12


def test_a_moved_scene_gives_moved_rays_and_either_normal_will_do():
    rng = np.random.default_rng(4)
    points, camera = lens_points(rng), np.array([30.0, -20, 600])
    turn, shift = random_rotation(rng), np.array([1e4, -5e3, 800.0])
    still = refract(thin(-6.0), camera, points)
    for sign in (1.0, -3.0):
        lens = ThinLens(shift, sign * turn[:, 2], -6.0)
        moved = refract(lens, turn @ camera + shift, points @ turn.T + shift)
        assert angle_deg(moved.directions, still.directions @ turn.T).max() < 1e-9
        assert_allclose(moved.origins, still.origins @ turn.T + shift, atol=1e-8)


def test_any_point_on_a_ray_names_it():
    points, camera = lens_points(np.random.default_rng(5)), np.array([0.0, 30, 600])
    bent = refract(thin(7.0), camera, points).directions
    for along in (0.2, 0.99, 1.01, 3.0):
        rays = refract(thin(7.0), camera, camera + along * (points - camera))
        assert_allclose(rays.origins, points, atol=1e-10)
        assert angle_deg(rays.directions, bent).max() < 1e-10


def test_what_no_lens_can_do_is_said():
    above = [0.0, 0, 600]
    for camera, points, kind, words in (
        ([0.0, 0, 0], [[1.0, 2, 0]], EyeglassesError, "camera lies in the lens plane"),
        (above, [[0, 0, 0], [10, 0, 600], [0, 0, 700.0]], EyeglassesError, "2 of 3 rays .* never reach"),
        (above, [[np.nan, 0, 0]], EyeglassesError, "points: 1 values are NaN"),
        ([above] * 3, [[1.0, 2, 0]] * 2, ValueError, "shape"),
    ):
        with pytest.raises(kind, match=words):
            refract(thin(0.0), camera, points)
    assert refract(thin(0.0), [0.0, 0, 600], np.zeros((0, 3))).directions.shape == (0, 3)
