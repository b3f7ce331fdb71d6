"""Soft light of a room: on shapes whose light is known in closed form."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.meshes import sphere
from numpy.testing import assert_allclose
from worlds.rooms import Room, room_light_on

from scan2albedo.synthetic.renderer import RayScene

EVEN = Room(np.ones(3), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)))


def lit(vertices, faces, normals, room, albedo=(0.5, 0.5, 0.5)):
    shape = SimpleNamespace(vertices=vertices, faces=faces, normals=normals)
    shape.albedo_at = lambda face, _: np.tile(albedo, (len(face), 1))
    return room_light_on(shape, RayScene(vertices, faces), np.random.default_rng(0), room)


@pytest.fixture(scope="module")
def ball():
    return sphere(4, 80.0)


def test_nothing_shadows_a_ball(ball):
    vertices, faces = ball
    assert_allclose(lit(vertices, faces, vertices / 80, EVEN), 1.0, atol=0.01)
    # Half of the directions shine, of which those around the top see all and those around the bottom none.
    sky = Room(np.zeros(3), np.array([[0.0, 1, 0]]), np.array([2.0]), np.array([[1.0, 2, 3]]))
    light = lit(vertices, faces, vertices / 80, sky)
    assert_allclose(light[:, 2], 3 * light[:, 0], rtol=1e-6)
    # At the top: 2 integral_0^1 exp(2 (t - 1)) t dt = (1 + exp(-2)) / 2.
    assert light[:, 0].max() == pytest.approx((1 + np.exp(-2)) / 2, rel=0.02)


def test_a_bowl_hides_half_of_the_room_from_itself_and_throws_its_colour_back(ball):
    vertices, faces = ball
    bowl = faces[(vertices[faces][..., 1] <= 1e-6).all(1)][:, ::-1]
    light = lit(vertices, bowl, -vertices / 80, EVEN, albedo=(0.8, 0.4, 0.0))[vertices[:, 1] < -20]
    # All of the bowl sees half of the room, and the bowl in the other half.
    assert_allclose(light.mean(0), [0.5 + 0.2, 0.5 + 0.1, 0.5], rtol=0.02)
    assert light.std(0).max() < 0.03
