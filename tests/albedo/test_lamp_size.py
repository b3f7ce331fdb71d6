"""The angular radius of lamps, and the colour of bounced light on a path-traced picture."""

import math

import numpy as np
import pytest
from helpers.lit_scenes import percent_off
from worlds.mitsuba_scenes import load_scenes

from scan2albedo.albedo import EstimateOptions, estimate_albedo
from scan2albedo.synthetic import face, light_at

SIZE = "albedo.lamp_size"
ELEVATION = 10
LAMPS = 40


def _disc(azimuth_deg, radius_deg):
    """Return lamps that fill a disc of some radius evenly, of the intensity of one."""
    number = np.arange(LAMPS) + 0.5
    radius, turn = radius_deg * np.sqrt(number / LAMPS), number * math.pi * (3 - math.sqrt(5))
    across = radius * np.cos(turn) / math.cos(math.radians(ELEVATION))
    return [
        light_at(azimuth_deg + x, ELEVATION + y, intensity=3.0 / LAMPS)
        for x, y in zip(across, radius * np.sin(turn), strict=True)
    ]


def _solved(scene, **options):
    estimate = estimate_albedo(scene.image, 1, options=EstimateOptions(**options))
    return estimate, percent_off(estimate, scene)


@pytest.mark.slow
@pytest.mark.parametrize("azimuth_deg", [50, -35])
def test_a_wide_lamp_is_told_from_a_point_and_no_worse_for_it(azimuth_deg):
    wide = face(0, texture="skin", size=96, lights=_disc(azimuth_deg, 25))
    point = face(0, texture="skin", size=96, lights=[light_at(azimuth_deg, ELEVATION)])
    (found, error), (sharp, _) = _solved(wide), _solved(point)
    assert found.plan.ran(SIZE)
    assert found.lights[0].radius_deg > sharp.lights[0].radius_deg
    assert found.lights[0].radius_deg >= 6
    left_out, without = _solved(wide, skip=(SIZE,))
    assert [light.radius_deg for light in left_out.lights] == [0]
    assert error < 1.1 * without
    assert error < 0.025


@pytest.mark.slow
def test_bounced_light_has_the_colour_of_wood():
    (scene,) = load_scenes(["face-wood-distant-30"])
    assert percent_off(estimate_albedo(scene.image), scene) < 0.037
