"""Details of the albedo: what is shared with the light, and what is not said."""

from dataclasses import replace

import numpy as np
from helpers.meshes import grid
from numpy.testing import assert_allclose
from worlds.environments import generated_environment

from scan2albedo.lighting.harmonics import project_environment
from scan2albedo.reflectance import (
    ImageObservation,
    MorphableReflectanceModel,
    reflectance_from_albedo,
    shade_environment,
)
from scan2albedo.reflectance.albedo_details import ShadingDivided, detail_field

SIDE = 41
SQUARE, FACES = grid(SIDE, SIDE)
VERTICES = 3.0 * (SIDE - 1) * SQUARE
X, Y, _ = VERTICES.T
ALL = np.ones(SIDE**2, bool)


def ripple(length_mm):
    return np.sin(2 * np.pi * X / length_mm) * np.sin(2 * np.pi * Y / length_mm)


def divided(residual, usable):
    """Return a matt picture's residual (V, 3)."""
    none = np.zeros_like(residual)
    return ShadingDivided(residual, usable, ALL, none, residual, np.zeros((3, 3)), none)


def kept(length_mm, color, size):
    residual = size * ripple(length_mm)[:, None] * color
    found = detail_field(divided(residual, ALL), VERTICES, FACES)
    return np.sum(found * residual) / np.sum(residual**2)


def test_strong_colour_is_albedo_and_what_is_weak_and_grey_is_light():
    assert kept(30.0, np.array([0.3, 1.0, 0.9]), 0.3) > 0.7
    assert kept(30.0, np.ones(3), 0.01) < 0.2
    assert kept(30.0, np.array([1.0, -1.0, 0.0]), 0.05) > kept(30.0, np.ones(3), 0.05) + 0.2


def test_wide_fields_stay_with_the_light():
    slope = 0.3 * (X - X.mean())[:, None] / 60 * np.ones(3)
    found = detail_field(divided(slope, ALL), VERTICES, FACES)
    middle = np.hypot(X - 60, Y - 60) < 20
    assert np.abs(found[middle]).max() < 0.5 * np.abs(slope[middle]).max()
    assert kept(30.0, np.ones(3), 0.3) > 0.6


def test_nothing_is_said_far_from_what_tells():
    usable = X < 30
    residual = np.where(usable[:, None], 0.3 * ripple(30.0)[:, None] * [0.3, 1.0, 0.9], 9.0)
    found = detail_field(divided(residual, usable), VERTICES, FACES)
    assert np.abs(found).max() < 0.5
    assert np.abs(found[X > 60]).max() < 1e-3
    assert not detail_field(divided(residual, np.zeros_like(usable)), VERTICES, FACES).any()


def test_details_change_the_diffuse_part_and_highlights_tell_nothing_about_them():
    normals = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [0.0, 0.6, 0.8]])
    people = [reflectance_from_albedo(np.full((3, 3), v), weights=[0.2] * 3) for v in (0.3, 0.5)]
    model = MorphableReflectanceModel.from_samples(people)
    light = project_environment(generated_environment(4))
    view = np.tile([0.0, 0.0, 1.0], (3, 1))
    matt = reflectance_from_albedo(np.full((3, 3), 0.4))
    face = replace(matt, weights=np.repeat([[0.0], [0.03], [9.0]], 3, 1))
    diffuse = shade_environment(matt, normals, view, light).radiance_linear
    whole = shade_environment(face, normals, view, light).radiance_linear
    found = ShadingDivided.from_observation(
        ImageObservation(whole, normals, view, matt.known), model, face, light
    )
    assert (found.usable == [True, True, False]).all()
    assert found.illuminated.all()
    assert_allclose(found.log_ratio, 0.0, atol=1e-9)
    assert_allclose(found.left_over(), 0.0, atol=1e-9)
    field = np.log([0.7, 1.0, 1.2]) * np.ones((3, 1))
    with_field = whole + diffuse * (np.exp(field) - 1)
    assert_allclose(found.left_over(field), np.log(whole / with_field), atol=1e-9)
