"""Lobes are those of the equation, written out once more in plain NumPy."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from worlds.flash_captures import head_capture, radiance

from scan2albedo.reflectance import point_light_lobes, point_light_radiance, reflectance_from_albedo


def test_radiance_is_that_of_the_equation():
    capture = head_capture(300)
    expected, _ = radiance(capture)
    lobes = point_light_lobes(capture.vertices, capture.normals, capture.cameras, capture.lights)
    assert_allclose(point_light_radiance(capture.truth, lobes), expected, atol=1e-14)
    # A flash at the camera makes the first lobe proportional to the diffuse one.
    lobes = point_light_lobes(capture.vertices, capture.normals, capture.cameras, capture.cameras)
    assert_allclose(lobes[..., 1], 3 / 8 * lobes[..., 0], rtol=1e-12)


def test_light_falls_off_with_the_square_of_its_distance():
    arrays = [[0.0, 0, 0]], [[0.0, 0, 1]], [[0, 0, 500.0], [0, 0, 500]], [[0, 0, 500.0], [0, 0, 1000]]
    near, far = point_light_lobes(*arrays, reference_distance_mm=500)[:, 0]
    assert_allclose(near, 4 * far)
    assert_allclose(near, point_light_lobes(*arrays)[0, 0])


def test_nothing_comes_of_a_light_behind_or_opposite_or_at_the_vertex():
    z = [[0.0, 0, 1]]
    for light in ([0, 0, -500.0], [500, 0, 0], [0, 0, 0]):
        assert (point_light_lobes([[0.0, 0, 0]], z, [[0, 0, 500.0]], [light]) == 0).all()
    opposite = point_light_lobes([[0.0, 0, 0]], z, [[-300, 0, -1e-9]], [[300, 0, 1e-9]])
    assert np.isfinite(opposite).all()


def test_what_is_not_known_sends_nan():
    face = reflectance_from_albedo([[1, 1, 1], [np.nan] * 3])
    assert np.isnan(point_light_radiance(face, np.ones((1, 2, 4)))).tolist() == [[[False] * 3, [True] * 3]]


def test_shapes_that_disagree_are_refused():
    one, two = np.zeros((1, 3)), np.zeros((2, 3))
    for of, arguments, words in (
        (point_light_lobes, (one, two, one, one), "normals is"),
        (point_light_lobes, (one, one, one, two), "light_positions is"),
        (point_light_radiance, (reflectance_from_albedo(one), np.ones((1, 2, 4))), r"expected \(J, 1, 4\)"),
    ):
        with pytest.raises(ValueError, match=words):
            of(*arguments)
