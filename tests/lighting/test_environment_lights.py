"""Environments as distant lights: cells part the sphere, nothing is lost or gained."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.geometry.mesh import normalized
from scan2albedo.lighting.environment import (
    DistantLights,
    distant_directions,
    environment_weights,
    important_directions,
    texel_directions,
)

UP = [[0, 0, 1]]


@pytest.mark.parametrize("shape", [(1, 1), (32, 64), (256, 512), (300, 20)])
@pytest.mark.parametrize("count", [1, 20])
def test_weights_are_the_integrals_over_the_nearest_directions(shape, count):
    rng = np.random.default_rng(1)
    directions, image = rng.normal(size=(count, 3)), rng.random((*shape, 3))
    # Texels of coarse maps are parts of several cells.
    cut = -(-256 // shape[0])
    fine = image.repeat(cut, 0).repeat(cut, 1)
    rows, columns = fine.shape[:2]
    edges = np.cos(np.linspace(0, np.pi, rows + 1))
    size = (edges[:-1] - edges[1:]) * 2 * np.pi / columns
    polar = (np.arange(rows) + 0.5) / rows * np.pi
    azimuth = ((np.arange(columns) + 0.5) / columns - 0.5) * 2 * np.pi
    sine, cosine = np.sin(polar)[:, None], np.cos(polar)[:, None]
    sphere = np.stack(np.broadcast_arrays(sine * np.sin(azimuth), cosine, sine * np.cos(azimuth)), -1)
    nearest = (sphere.reshape(-1, 3) @ normalized(directions).T).argmax(1)
    light = (size[:, None, None] * fine).reshape(-1, 3)
    expected = np.stack([np.bincount(nearest, light[:, c], minlength=count) for c in range(3)], 1)
    assert_allclose(environment_weights(image, directions), expected, rtol=1e-9)


@pytest.mark.parametrize("count", [1, 2, 10, 200])
def test_directions_are_even(count):
    directions = distant_directions(count)
    assert_allclose(np.linalg.norm(directions, axis=1), 1, rtol=1e-12)
    cells = environment_weights(np.ones((1, 1, 3)), directions)[:, 0]
    assert cells.max() <= 1.5 * cells.min()


@pytest.mark.parametrize(
    ("function", "arguments", "message"),
    [
        (distant_directions, (0,), "count"),
        (important_directions, (np.ones((4, 8, 3)), 0), "1 or more"),
        (environment_weights, (np.ones((2, 4, 3)), [[0, 0, 0]]), "not zero"),
        (environment_weights, (np.ones((2, 4, 3)), np.zeros((0, 3))), "directions must be one or more"),
        (environment_weights, (np.full((2, 4, 3), np.inf), UP), "environment_linear: 24 values are NaN"),
        (environment_weights, (np.ones((2, 4)), UP), "environment_linear is"),
        (DistantLights, (UP, np.ones((2, 3))), "irradiance_linear is"),
        (DistantLights, (UP, [np.nan]), "irradiance_linear: 3 values are NaN"),
    ],
)
def test_what_is_no_light_is_refused(function, arguments, message):
    with pytest.raises(ValueError, match=message):
        function(*arguments)


def test_a_number_is_a_grey_light():
    grey = DistantLights([[0, 0, 2.0]], [3.0])
    assert grey.irradiance_linear.tolist() == [[3, 3, 3]]
    assert grey.directions.tolist() == [[0, 0, 1]]


def lamps():
    """A dim room with two lamps, one of them small."""
    toward = texel_directions((64, 128))
    image = np.full((64, 128, 3), 0.1)
    image[toward @ [0.6, 0.0, 0.8] > 0.9] = 4.0
    image[toward @ [0.0, 0.8, -0.6] > 0.995] = 60.0
    return image


def test_important_directions_share_the_light_evenly():
    image = lamps()
    toward = important_directions(image, 128)
    assert_allclose(np.linalg.norm(toward, axis=1), 1, atol=1e-12)
    weights = environment_weights(image, toward).mean(1)
    assert weights.max() < 3 * weights.mean()
    even = environment_weights(image, distant_directions(128)).mean(1)
    assert even.max() > 15 * even.mean()


def test_important_directions_of_a_fine_map_are_those_of_a_coarse_one():
    image = lamps()
    maps = image, image.repeat(9, 0).repeat(9, 1)
    coarse, fine = (environment_weights(image, important_directions(one, 64)).mean(1) for one in maps)
    assert fine.max() < 3 * fine.mean()
    assert_allclose(np.sort(coarse)[-5:], np.sort(fine)[-5:], rtol=0.5)


def test_important_directions_of_no_light_are_even():
    assert_array_equal(important_directions(np.zeros((4, 8, 3)), 9), distant_directions(9))
    assert important_directions(np.ones((1, 1, 3)), 1).shape == (1, 3)
