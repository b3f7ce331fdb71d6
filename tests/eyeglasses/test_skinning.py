"""Skinning, and transforms of key points: exact for rigid motions, of the whole or of one side."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from scan2albedo.eyeglasses import skin
from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES
from scan2albedo.eyeglasses.skinning import translations, turned_translations
from scan2albedo.geometry.rigid import rotation_from_vector, transform_points
from scan2albedo.synthetic import GlassesBend, eyeglasses

POINTS = eyeglasses(0).keypoints


SHARES = np.random.default_rng(0).dirichlet(np.ones(3), 20)
"""Of three handles, whose affine maps follow."""
MAPS = np.tile(np.eye(4), (3, 1, 1))
MAPS[:, :3] += np.random.default_rng(1).normal(0, 0.3, (3, 3, 4))


def test_vertices_are_means_of_where_the_handles_would_take_them():
    each = np.stack([transform_points(one, POINTS) for one in MAPS], 1)
    for maps in (MAPS, MAPS[:, :3]):
        assert_allclose(skin(POINTS, SHARES, maps), np.einsum("vk,vki->vi", SHARES, each), atol=1e-12)


@pytest.mark.parametrize(
    ("points", "maps", "words"),
    [
        (POINTS[0], MAPS, r"vertices is \(3,\), expected \(V, 3\)"),
        (POINTS, MAPS[:, :3, :3], r"transforms is \(3, 3, 3\), expected \(K, R, 4\)"),
        (POINTS, MAPS[:2], r"weights is .* expected \(20, 2\)"),
    ],
)
def test_shapes_that_do_not_fit_are_named(points, maps, words):
    with pytest.raises(ValueError, match=words):
        skin(points, SHARES, maps)


def carried(transforms, points):
    return np.einsum("kij,kj->ki", transforms[:, :3, :3], points) + transforms[:, :3, 3]


@pytest.mark.parametrize("make", [translations, turned_translations])
def test_key_points_meet_their_targets(make):
    target = eyeglasses(3, bend=GlassesBend(20, 5, 5)).keypoints
    assert_allclose(carried(make(POINTS, target), POINTS), target, atol=1e-11)


def test_a_turn_of_one_side_turns_its_key_points():
    turn = rotation_from_vector([0.05, -0.1, 0.02])
    left = np.array([name.startswith("left") for name in KEY_POINT_NAMES])
    target = np.where(left[:, None], POINTS @ turn.T, POINTS)
    found = turned_translations(POINTS, target)
    # The rim's top and outer side and the temple behind it; the right rim's top.
    assert_allclose(found[[2, 6, 9, 10], :3, :3], np.tile(turn, (4, 1, 1)), atol=5e-3)
    assert_allclose(found[11, :3, :3], np.eye(3), atol=5e-3)


def test_what_nothing_fixes_stays():
    """A straight temple without its hinge: no bone says how it is turned about itself."""
    rim, temple = slice(2, 7), slice(8, 11)
    points = np.full((20, 3), np.nan)
    points[rim] = POINTS[rim]
    points[temple] = [[70.0, 11, -60], [70, 11, -120], [70, 11, -150]]
    target = points.copy()
    target[temple, 0] += [0, 2, 3]
    found = turned_translations(points, target)[temple]
    assert_allclose(carried(found, points[temple]), target[temple], atol=1e-11)
    spread = rotation_from_vector([0, np.arctan2(-2, 60), 0])
    assert_allclose(found[:, :3, :3], np.tile(spread, (3, 1, 1)), atol=2e-3)
