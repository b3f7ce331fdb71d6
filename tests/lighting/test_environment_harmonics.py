"""Coefficients of environment maps: closed forms, and what is not a map."""

import numpy as np
import pytest

from scan2albedo.lighting.environment import texel_directions
from scan2albedo.lighting.harmonics import harmonics, project_environment


@pytest.mark.parametrize("shape", [(1, 1), (3, 5), (16, 32), (130, 40)])
def test_constant_light_has_one_coefficient(shape):
    coefficients = project_environment(np.full((*shape, 3), 2.0))
    np.testing.assert_allclose(coefficients[0], 2 * np.sqrt(4 * np.pi), rtol=1e-7)
    assert np.abs(coefficients[1:]).max() < 1e-6


def test_light_from_above_is_a_series_in_y_alone():
    upper = np.zeros((2, 4, 3))
    upper[0] = 1.0
    coefficients = project_environment(upper)[:, 0]
    assert coefficients[1] == pytest.approx(np.pi * np.sqrt(3 / (4 * np.pi)), rel=1e-7)
    assert coefficients[2:4] == pytest.approx([0, 0], abs=1e-7)


def test_a_smooth_map_gives_back_its_coefficients():
    truth = np.random.default_rng(0).normal(size=(81, 3))
    image = harmonics(texel_directions((128, 256))) @ truth
    error = np.abs(project_environment(image) - truth).max() / np.abs(truth).max()
    assert error < 3e-3  # constant texels blur degree 8 by (8 pi / 128)^2 / 24


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.ones((4, 8)), "is"),
        (np.ones((0, 8, 3)), "no texel"),
        (np.full((2, 4, 3), np.nan), "24 values are NaN"),
    ],
)
def test_what_is_no_map_is_refused(image, message):
    with pytest.raises(ValueError, match=message):
        project_environment(image)
