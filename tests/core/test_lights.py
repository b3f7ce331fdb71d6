"""Lamps and environments: what they refuse, and what their defaults are."""

import math

import numpy as np
import pytest

from scan2albedo.core import EnvironmentLight, PointLight


def test_a_lamp_is_a_white_point_unless_told_otherwise():
    assert PointLight(0.1, 0.2).white
    assert PointLight(0.1, 0.2).radius_deg == 0
    assert not PointLight(0, 0, color_linear=(1.5, 1.0, 0.5)).white


COLORS = ((2.0, 1.0, 1.0), (-0.5, 1.5, 2.0), (math.nan, 1.0, 1.0), (1.0, 1.0))


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        *(({"color_linear": color}, "color_linear must be .* whose mean is 1") for color in COLORS),
        *(({"radius_deg": radius}, "radius_deg must be from 0") for radius in (-1.0, 90.0, math.nan)),
    ],
)
def test_what_is_no_lamp_is_refused(wrong, named):
    with pytest.raises(ValueError, match=named):
        PointLight(0, 0, **wrong)


def test_an_environment_keeps_its_own_coefficients():
    given = np.ones((9, 3))
    light = EnvironmentLight(given)
    given[:] = 0
    assert light.coefficients.min() == 1


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"coefficients": np.ones((3, 9))}, "expected .9, 3."),
        ({"coefficients": np.full((9, 3), np.nan)}, "finite"),
        ({"coefficients": np.ones((9, 3)), "fill": 1.5}, "fill is 1.5"),
        ({"coefficients": np.ones((9, 3)), "bounce": -0.1}, "bounce is -0.1"),
    ],
)
def test_what_is_no_environment_is_refused(wrong, named):
    with pytest.raises(ValueError, match=named):
        EnvironmentLight(**wrong)
