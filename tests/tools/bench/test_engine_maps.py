"""PSNR after the best exposure; and maps on a board in Mitsuba, against closed forms."""

import numpy as np
import pytest
from bench.engine_maps import PATH, Face, Studio, likeness, radiance_of
from helpers.meshes import grid
from helpers.mitsuba import needs_mitsuba
from numpy.testing import assert_allclose

from scan2albedo.core.lights import EnvironmentLight, PointLight
from scan2albedo.io.color import linear_to_srgb
from scan2albedo.unlit.template_baking import TemplateTexture, TemplateTile


def test_likeness_is_psnr_of_srgb_after_the_best_exposure():
    rng = np.random.default_rng(0)
    reference = rng.uniform(0.1, 0.7, (40, 40, 3))
    counted = np.zeros((40, 40), bool)
    counted[:20] = True
    picture = reference / 3
    picture[20:] = 7.0  # does not count
    psnr_db, exposure = likeness(picture, reference, counted)
    assert psnr_db > 80
    assert exposure == pytest.approx(3, rel=1e-4)
    # One channel with another exposure: no single one mends that.
    off = reference * [1.0, 1.0, 1.2]
    steps = [
        np.mean((linear_to_srgb(s * off) - linear_to_srgb(reference)) ** 2) for s in np.linspace(0.8, 1, 400)
    ]
    assert likeness(off, reference, np.ones((40, 40), bool))[0] == pytest.approx(
        -10 * np.log10(min(steps)), abs=0.01
    )


def test_radiance_of_an_environment():
    coefficients = np.zeros((9, 3))
    coefficients[0] = 1.0
    coefficients[1] = [0.1, 0.2, 0.3]
    up, down = radiance_of(EnvironmentLight(coefficients), np.array([[0.0, 1, 0], [0, -1, 0]]))
    # Y_1 / Y_0 along +y is the square root of 3.
    assert_allclose(up, 1 + np.sqrt(3) * coefficients[1])
    assert_allclose(down, 1 - np.sqrt(3) * coefficients[1])


def board(normal, high_mm):
    """A board of 100 mm that looks along +z, with the same normal and height all over."""
    flat, faces = grid(5, 5)
    maps = {"displacement_mm": np.full((8, 8), high_mm), "occlusion": np.ones((8, 8))}
    tile = TemplateTile(
        1001,
        np.ones(len(faces), bool),
        np.full((8, 8, 3), 0.5),
        np.ones((8, 8), bool),
        np.tile(normal, (8, 8, 1)),
        maps,
    )
    return TemplateTexture(100 * (flat - [0.5, 0.5, 0]), faces, flat[faces][..., :2], (tile,))


@pytest.mark.slow
@needs_mitsuba
def test_mitsuba_reads_maps_and_light_as_they_are_meant():
    # Green of a normal map leans toward +y, red toward +x.
    normal, lamp = np.array([0.36, 0.48, 0.8]), PointLight(0.5, 0.7, np.inf, 2.0, (1.2, 1.0, 0.8), 3.0)
    baked = board(normal, high_mm=2.0)
    studio = Studio(baked.vertices, 16, 256)
    face = Face(studio, baked)
    assert face.displaced[0][:, 2] == pytest.approx(2.0)
    assert_allclose(face.own[1], np.tile((0.0, 0, 1), (len(face.own[1]), 1)), atol=1e-9)
    color = np.full((8, 8, 3), 0.5)
    middle = np.s_[4:-4, 4:-4]

    def seen(maps, *light):
        surface = face.material(color, maps, lambert=True)
        return studio.picture(PATH, face=surface, **studio.light(*light))[middle].mean((0, 1))

    flat, leaning = (seen(maps, (lamp,), None) for maps in ("", "normals"))
    assert_allclose(flat, 0.5 * 2 * lamp.direction[2] * np.array(lamp.color_linear), rtol=0.02)
    assert_allclose(leaning / flat, normal @ lamp.direction / lamp.direction[2], rtol=0.02)
    assert_allclose(seen("", (), EnvironmentLight.constant()), 0.5, rtol=0.02)
    # A sky with a dark side below 0: the light on a board is c_0 + 2/3 c_1 Y_1 / Y_0.
    coefficients = np.zeros((9, 3))
    coefficients[0] = 1.0
    coefficients[2] = 0.8
    expected = 0.5 * (1 + 2 / 3 * 0.8 * np.sqrt(3))
    assert_allclose(seen("", (), EnvironmentLight(coefficients)), expected, rtol=0.02)
    surface = face.material(color, lambert=True)
    sky = studio.light((), EnvironmentLight(coefficients))
    assert_allclose(studio.picture({"type": "open_sky"}, face=surface, **sky)[middle], expected, rtol=0.2)
