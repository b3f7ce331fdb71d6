"""The compiled ASRM against a loop over the readable reflectance functions."""

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


def _points():
    rng = np.random.default_rng(3)
    normal = normalized(rng.standard_normal((500, 3)))
    return rng.uniform(-80, 80, normal.shape), normal, rng


def _reference(position, normal, lights, reflectance, visible, scale):
    light, specular = np.ones(len(position)), np.zeros(len(position))
    for k, lamp in enumerate(lights):
        vector = lamp.direction - position / lamp.distance_mm
        energy = lamp.intensity / np.sum(vector**2, 1)
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
        position, normal, LIGHTS, reflectance, visible=visible, view_direction=3 * VIEW, specular_scale=scale
    )
    light, specular = _reference(position, normal, LIGHTS, reflectance, visible, scale)
    assert ours.light == pytest.approx(light, rel=1e-9)
    assert ours.specular == pytest.approx(specular, rel=1e-9, abs=1e-12)


def test_a_light_stands_in_a_direction_of_any_length():
    toward = np.array([0.3, 0.4, 1.0])
    assert light_from_direction(toward, 300.0, 2.5).direction == pytest.approx(normalized(toward))


def test_a_coloured_lamp_colours_its_own_light_and_no_highlight():
    position, normal, _ = _points()
    skin = Reflectance("oren-nayar", 0.4, 0.2)
    warm = [replace(LIGHTS[0], color_linear=(1.4, 1.0, 0.6)), LIGHTS[1]]
    white, colored = (shade_points(position, normal, lamps, skin) for lamps in (LIGHTS, warm))
    first = shade_points(position, normal, LIGHTS[:1], skin, view_direction=(0, 0, 1)).light - 1
    assert np.array_equal(white.light_linear, np.repeat(white.light[:, None], 3, 1))
    assert colored.light_linear == pytest.approx(white.light[:, None] + first[:, None] * [0.4, 0, -0.4])
    assert np.array_equal(colored.light, white.light)
    assert np.array_equal(colored.specular, white.specular)


def test_without_a_light_the_ambient_term_is_left():
    position, normal, _ = _points()
    shading = shade_points(position, normal, (), Reflectance(specular_strength=0.5))
    assert np.all(shading.light == 1)
    assert np.all(shading.specular == 0)


def test_reflectances_that_are_none_are_refused():
    with pytest.raises(ValueError, match="expected one of"):
        Reflectance("cook-torrance")
    with pytest.raises(ValueError, match="roughness 0"):
        Reflectance("lambert", 0.3)
