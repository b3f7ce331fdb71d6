"""The noise of a surface is read from its vertices, whatever its shape and the length of its edges."""

import numpy as np
import pytest
from helpers.meshes import sphere

from scan2albedo.geometry.mesh import vertex_normals
from scan2albedo.geometry.oriented_points import SurfaceNoise


@pytest.fixture(scope="module")
def ball():
    return sphere(4, 90.0)


def _noisy(ball, noise_mm):
    offset = np.random.default_rng(7).normal(scale=noise_mm, size=(len(ball[0]), 1))
    return ball[0] + offset * vertex_normals(*ball)


@pytest.mark.parametrize("noise_mm", [0.3, 1.0, 3.0])
def test_noise_is_measured(ball, noise_mm):
    noise = SurfaceNoise.of(_noisy(ball, noise_mm), ball[1])
    found_mm, area_mm2 = noise.among(np.ones(len(ball[0]), bool))
    assert found_mm == pytest.approx(noise_mm, rel=0.15)
    assert area_mm2 * len(ball[0]) == pytest.approx(noise.area.sum())


def test_a_smooth_surface_has_hardly_any(ball):
    assert SurfaceNoise.of(*ball).among(np.ones(len(ball[0]), bool))[0] < 0.15


def test_only_the_chosen_vertices_count(ball):
    front = ball[0][:, 2] > 0
    points = np.where(front[:, None], _noisy(ball, 2.0), ball[0])
    noise = SurfaceNoise.of(points, ball[1])
    assert noise.among(ball[0][:, 2] > 20)[0] > 1.5
    assert noise.among(ball[0][:, 2] < -20)[0] < 0.15


def test_few_vertices_say_nothing(ball):
    noise = SurfaceNoise.of(_noisy(ball, 2.0), ball[1])
    assert noise.among(np.arange(len(ball[0])) < 10) == (0.0, 0.0)


def test_loose_triangles_say_nothing():
    points = np.random.default_rng(1).normal(scale=50, size=(90, 3))
    noise = SurfaceNoise.of(points, np.arange(90).reshape(30, 3))
    assert np.isnan(noise.gap).all()
    assert noise.among(np.ones(90, bool)) == (0.0, 0.0)
