"""Where the light is looked for first, and what a budget of next to nothing gives."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.lit_scenes import percent_off, plan_row, shaded_image

from scan2albedo.albedo import EstimateOptions, albedo_error, estimate_albedo
from scan2albedo.albedo.levels import build_level, usable_texels
from scan2albedo.albedo.shaded_image import shading_direction
from scan2albedo.synthetic import face, hemisphere, light_at


def level_of(scene):
    return build_level(scene.image, usable_texels(scene.image), 32)


@pytest.mark.parametrize(("azimuth", "elevation"), [(0, 0), (45, 10), (-60, -20)])
def test_shading_grows_toward_the_light(azimuth, elevation):
    light = light_at(azimuth, elevation)
    scene = hemisphere(size=64, texture="wood", lights=[light])
    assert np.degrees(np.arccos(shading_direction(level_of(scene)) @ light.direction)) < 25


def test_even_light_comes_from_the_front():
    level = level_of(hemisphere(size=32, texture="plain"))
    even = replace(level, value=np.full(len(level.value), 0.7))
    np.testing.assert_array_equal(shading_direction(even), [0, 0, 1])


def test_directions_are_all_kept_nearest_first():
    scene = hemisphere(size=64, texture="wood", lights=[light_at(45, 10)])
    searched = shaded_image(scene.image)
    toward = shading_direction(searched.at(searched.options.sizes[0]).level)
    assert (np.diff(searched.directions @ toward) <= 0).all()
    assert len(np.unique(searched.directions, axis=0)) == 60


@pytest.mark.parametrize("lights", [[light_at(50, 10)], [light_at(50, 10), light_at(-40, 5, intensity=2)]])
def test_no_time_at_all_still_takes_most_of_the_light_away_and_what_it_lacked_is_said(lights):
    scene = face(3, size=64, lights=lights)
    estimate = estimate_albedo(scene.image, budget=1e-6)
    unlit = albedo_error(scene.image.texture_linear, scene.albedo_linear, scene.image.mask)
    assert percent_off(estimate, scene) < 0.6 * unlit.mse_percent
    assert not estimate.converged
    assert plan_row(estimate, "shadows").reason == "the budget ended before it was judged"
    assert plan_row(estimate, "inpainting").reason == "the budget ended before it"
    assert plan_row(estimate, "specular")


def test_what_was_asked_for_is_done_without_time():
    options = EstimateOptions(force=("albedo.inpainting",))
    estimate = estimate_albedo(face(3, size=64).image, 1, budget=1e-6, options=options)
    assert plan_row(estimate, "inpainting").reason == "nothing is saturated"
