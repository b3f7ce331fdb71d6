"""Named extremes: nothing travels silently, nothing blows up."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.lit_scenes import lit_scene, percent_off

from scan2albedo.albedo import EstimateOptions, albedo_error, estimate_albedo
from scan2albedo.synthetic import Material, face, hemisphere, light_at


@pytest.fixture(scope="module")
def plain():
    return lit_scene((30, 0))


def test_exposure_only_scales_the_albedo(plain):
    dark = replace(plain.image, texture_linear=plain.image.texture_linear * np.float32(1 / 64))
    bright, dim = (estimate_albedo(image, 1) for image in (plain.image, dark))
    assert dim.lights == bright.lights
    assert np.array_equal(dim.shading, bright.shading)
    # What 8 bits round is more of a dim picture, so a little less of it is taken for noise.
    near = np.isclose(dim.albedo_linear * 64, bright.albedo_linear, rtol=1e-3, atol=1e-4)
    assert near.mean() > 0.995
    assert dim.albedo_linear * 64 == pytest.approx(bright.albedo_linear, rel=6e-3, abs=1e-4)


def test_specular_scale_of_the_annotation_multiplies_the_highlight(plain):
    options = EstimateOptions(force=("albedo.specular",))
    scale = np.where(np.arange(64)[:, None] < 32, 0, 1) * np.ones((64, 64))
    estimate = estimate_albedo(replace(plain.image, specular_scale=scale), 1, options=options)
    assert np.all(estimate.specular[:32] == 0)


def test_finer_quantisation_is_no_worse_than_8_bits(plain):
    image = lit_scene((30, 0), bits=None).image
    errors = [np.sqrt(percent_off(estimate_albedo(one, 1), plain)) for one in (image, plain.image)]
    # The search ends a little elsewhere on any change of its input: 10 % are granted to it.
    assert errors[0] <= 1.1 * errors[1]


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_the_unit_of_length_matters_to_shadow_offsets_and_lamp_distances_alone(plain, scale):
    scaled = replace(plain.image, position=plain.image.position * scale)
    options = EstimateOptions(skip=("albedo.near_light", "albedo.shadows"))
    here, there = (estimate_albedo(image, 1, options=options) for image in (plain.image, scaled))
    assert there.albedo_linear == pytest.approx(here.albedo_linear, rel=1e-6, abs=1e-9)


@pytest.mark.slow
def test_a_symmetric_surface_lit_symmetrically():
    """Light and its mirror image explain such a picture alike; the albedo must not care."""
    frontal = lit_scene((0, 0), shape="bumps", kind="plain", size=96)
    assert frontal.image.texture_linear == pytest.approx(frontal.image.texture_linear[:, ::-1], abs=1e-6)
    estimate = estimate_albedo(frontal.image)
    albedo = estimate.albedo_linear
    assert percent_off(estimate, frontal) < 0.002
    assert albedo[..., 0] == pytest.approx(albedo[:, ::-1, 0], rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("make", [hemisphere, face])
def test_a_pair_of_lights_that_looks_like_one_costs_the_albedo_little(make):
    """A mirror-symmetric surface under a symmetric pair: one wide light between looks the same."""
    pair = [light_at(-12, 0, intensity=1.5), light_at(12, 0, intensity=1.5)]
    scene = make(texture="skin", lights=pair, seed=1)
    assert percent_off(estimate_albedo(scene.image), scene) < 0.025


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_cast_shadows_in_another_unit(scale):
    scene = lit_scene((45, 0), shape="bumps", size=96)
    estimate = estimate_albedo(replace(scene.image, position=scene.image.position * scale), 1)
    assert estimate.plan.ran("albedo.shadows")
    assert percent_off(estimate, scene) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("corner", [(40, 40), (64, 8), (64, 80)])
def test_a_few_texels_of_another_colour_do_not_take_the_highlight_away(corner):
    material = Material(specular_strength=0.3)
    scene = hemisphere(texture="skin", lights=[light_at(30)], material=material, seed=1)
    colors = scene.image.texture_linear.copy()
    row, column = corner
    colors[row : row + 2, column : column + 2] = 0, 0, 0.3
    estimate = estimate_albedo(replace(scene.image, texture_linear=colors))
    assert estimate.plan.ran("albedo.specular")
    error = albedo_error(estimate.albedo_linear[..., 0], scene.albedo_linear[..., 0], scene.image.mask)
    assert error.mse_percent < 0.003
