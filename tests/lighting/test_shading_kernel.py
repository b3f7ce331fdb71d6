"""The compiled ASRM against a loop over the readable reflectance functions, and its extremes."""

import math
from dataclasses import replace

import numpy as np
import pytest
from brdf_reference import minnaert, oren_nayar, phong

from scan2albedo.core.lights import PointLight
from scan2albedo.geometry.mesh import normalized
from scan2albedo.lighting.shading import Reflectance, light_from_direction, shade_points

LIGHTS = (PointLight(0.5, 0.2, 400.0, 2.0), PointLight(-1.1, 0.4, math.inf, 0.7))
VIEW = normalized(np.array([0.1, -0.2, 1.0]))


def _points(count=500, seed=3):
    rng = np.random.default_rng(seed)
    normal = normalized(rng.standard_normal((count, 3)))
    return rng.uniform(-80, 80, (count, 3)), normal, rng


def _reference(position, normal, lights, reflectance, visible, scale):
    light, specular = np.ones(len(position)), np.zeros(len(position))
    for k, lamp in enumerate(lights):
        if math.isinf(lamp.distance_mm):
            vector, energy = np.broadcast_to(lamp.direction, position.shape), lamp.intensity
        else:
            vector = lamp.distance_mm * lamp.direction - position
            energy = lamp.intensity * lamp.distance_mm**2 / np.sum(vector**2, 1)
        toward = normalized(vector)
        n_l, n_v, l_v = np.sum(normal * toward, 1), normal @ VIEW, toward @ VIEW
        if reflectance.brdf == "minnaert":
            diffuse = minnaert(n_l, n_v, reflectance.roughness)
        else:
            diffuse = oren_nayar(n_l, n_v, l_v, reflectance.roughness)
        light += visible[k] * energy * diffuse
        gloss = phong(n_l, n_v, l_v, reflectance.exponent)
        specular += visible[k] * energy * reflectance.specular_strength * scale * gloss
    return light, specular


@pytest.mark.parametrize(
    "reflectance",
    [
        Reflectance("lambert"),
        Reflectance("oren-nayar", 0.45, 0.3, 12.0),
        Reflectance("oren-nayar", 1.0, 0.3, 0.1),
        Reflectance("oren-nayar", 0.0, 0.3, 1e4),
        Reflectance("minnaert", 0.7, 0.1, 3.0),
    ],
)
def test_kernel_equals_the_reference(reflectance):
    position, normal, rng = _points()
    visible, scale = rng.integers(0, 2, (2, len(position))), rng.uniform(0, 2, len(position))
    ours = shade_points(
        position, normal, LIGHTS, reflectance, visible=visible, view_direction=VIEW, specular_scale=scale
    )
    light, specular = _reference(position, normal, LIGHTS, reflectance, visible, scale)
    assert ours.light == pytest.approx(light, rel=1e-9)
    assert ours.specular == pytest.approx(specular, rel=1e-9, abs=1e-12)


def test_facing_texel_at_the_origin_gets_the_intensity_from_any_distance():
    for distance in (300.0, math.inf):
        light = light_from_direction((0.3, 0.4, 1.0), distance, 2.5)
        shading = shade_points(np.zeros((1, 3)), light.direction[None], (light,), Reflectance())
        assert shading.light[0] == pytest.approx(3.5)


def test_a_coloured_lamp_colours_its_own_light_and_no_highlight():
    position, normal, _ = _points()
    skin = Reflectance(specular_strength=0.2)
    warm = [replace(LIGHTS[0], color_linear=(1.4, 1.0, 0.6)), LIGHTS[1]]
    white, colored = (shade_points(position, normal, lamps, skin) for lamps in (LIGHTS, warm))
    first = shade_points(position, normal, LIGHTS[:1], skin).light - 1
    assert np.array_equal(white.light_linear, np.repeat(white.light[:, None], 3, 1))
    assert colored.light_linear == pytest.approx(white.light[:, None] + first[:, None] * [0.4, 0, -0.4])
    assert np.array_equal(colored.light, white.light)
    assert np.array_equal(colored.specular, white.specular)


def test_inputs_are_not_changed_and_bad_names_are_refused():
    position, normal, _ = _points()
    before = position.copy(), normal.copy()
    shade_points(position, normal, LIGHTS, Reflectance(), view_direction=(0, 0, 2))
    assert np.array_equal(position, before[0])
    assert np.array_equal(normal, before[1])
    with pytest.raises(ValueError, match="expected one of"):
        Reflectance("cook-torrance")
    with pytest.raises(ValueError, match="roughness 0"):
        Reflectance("lambert", 0.3)


def test_no_light_and_light_behind_the_surface_leave_the_ambient_term():
    normal = np.tile([0.0, 0.0, 1.0], (50, 1))
    position = np.random.default_rng(0).uniform(-80, 80, (50, 3)) * [1, 1, 0]
    behind = [
        (light_from_direction(toward, distance, 5.0),)
        for toward, distance in (((0, 0, -1), math.inf), ((0.3, 0, -0.5), 300.0), ((1, 0, -0.01), math.inf))
    ]
    for lights in ((), *behind):
        for reflectance in (Reflectance("oren-nayar", 1.0, 0.5, 0.1), Reflectance("minnaert", 0.5, 0.5, 2.0)):
            shading = shade_points(position, normal, lights, reflectance)
            assert np.all(shading.light == 1)
            assert np.all(shading.specular == 0)


@pytest.mark.parametrize("sigma", [0.0, 1.0])
def test_grazing_light_is_small_and_finite(sigma):
    """At 89.9 degrees Oren-Nayar's tan(beta) is 573; what reaches the texel is below a hundredth."""
    angle = math.radians(89.9)
    light = light_from_direction((math.sin(angle), 0, math.cos(angle)), math.inf, 1.0)
    shading = shade_points(np.zeros((1, 3)), [[0.0, 0, 1]], (light,), Reflectance("oren-nayar", sigma))
    assert 1 < shading.light[0] < 1.01


@pytest.mark.parametrize("exponent", [0.1, 1.0, 1e4])
def test_highlights_peak_in_the_mirror_direction_for_any_exponent(exponent):
    light = light_from_direction((0, 0.6, 0.8), math.inf, 2.0)
    turn = np.linspace(-1.5, 1.5, 401)
    normals = np.stack([0 * turn, np.sin(turn), np.cos(turn)], 1)
    reflectance = Reflectance("oren-nayar", 0.2, 0.3, exponent)
    gloss = shade_points(np.zeros((401, 3)), normals, (light,), reflectance).specular
    assert abs(turn[np.argmax(gloss)] - math.atan2(0.6, 0.8) / 2) < 0.01
    assert gloss.max() == pytest.approx(0.6, rel=0.3)


def test_sigma_zero_equals_lambert_to_the_last_bit():
    position, normal, _ = _points()
    rough = shade_points(position, normal, LIGHTS, Reflectance("oren-nayar", 0.0))
    assert np.array_equal(rough.light, shade_points(position, normal, LIGHTS, Reflectance("lambert")).light)
