"""The path tracer against closed forms: a matte ball under a dome, under a lamp, and what gloss adds."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.meshes import sphere
from helpers.mitsuba import needs_mitsuba
from worlds.lamps import Environment, Lamp
from worlds.path_tracer import Part, Studio

ALBEDO = np.array([0.6, 0.4, 0.2], np.float32)

pytestmark = [pytest.mark.slow, needs_mitsuba]


@pytest.fixture(scope="module")
def ball():
    vertices, faces = sphere(5, 50.0)
    picture = np.tile(ALBEDO, (4, 4, 1))
    return Part(
        "face", vertices, vertices / 50, faces, np.full((len(vertices), 2), 0.5), picture, None, "matte"
    )


def seen(part, emitter):
    """Return normals (N, 3) and radiance (N, 3) of the side that looks along +z, each seen head-on."""
    chosen = part.normals[:, 2] > 0.2
    normal = part.normals[chosen]
    # A little inside a triangle, as a ray through a corner may miss.
    start = part.vertices[chosen] + 0.3 * normal + [0.01, 0.013, 0]
    return normal, Studio([part], nearest=True).radiance(emitter, start, -normal, paths=256)


def test_under_a_uniform_dome_a_matte_ball_looks_like_its_albedo(ball):
    _, radiance = seen(ball, Environment("uniform"))
    np.testing.assert_allclose(radiance, np.tile(ALBEDO, (len(radiance), 1)), rtol=0.01)


def test_a_lamp_of_strength_one_obeys_cosine_and_distance(ball):
    lamp = Lamp(30.0, 20.0, 1000.0, (5.0,))
    normal, radiance = seen(ball, lamp)
    toward = 1000 * lamp.direction - 50 * normal
    reach = np.linalg.norm(toward, axis=1)
    expected = np.maximum(0, np.einsum("ij,ij->i", normal, toward) / reach) * (1000 / reach) ** 2
    assert np.abs(radiance / ALBEDO - expected[:, None]).max() < 0.03


def test_gloss_keeps_the_diffuse_part_in_proportion_to_the_albedo(ball):
    glossy = replace(ball, bsdf="skin")
    _, bright = seen(glossy, Environment("uniform"))
    _, dark = seen(replace(glossy, albedo=glossy.albedo / 2), Environment("uniform"))
    # What both have in common is the highlight.
    highlight = 2 * dark - bright
    assert np.ptp(highlight.mean(0)) < 0.004
    assert 0.005 < highlight.mean() < 0.06
