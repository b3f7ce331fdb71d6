"""Skinning, and transforms of key points: exact for rigid motions, of the whole or of one side."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from scan2albedo.eyeglasses import skin
from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES
from scan2albedo.eyeglasses.skinning import translations, turned_translations
from scan2albedo.geometry.rigid import compose, random_rotation, rotation_from_vector, transform_points
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
    expected = dict.fromkeys(("left_temple_tip", "left_ear_bend", "left_rim_outer", "left_rim_top"), turn)
    for name, rotation in (expected | {"right_rim_top": np.eye(3)}).items():
        assert_allclose(found[KEY_POINT_NAMES.index(name), :3, :3], rotation, atol=5e-3)


def test_a_moderate_rigid_motion_is_met():
    motion = compose(rotation_from_vector([0.2, -0.3, 0.1]), [5.0, 6, 7])
    found = turned_translations(POINTS, transform_points(motion, POINTS))
    assert_allclose(found, np.tile(motion, (20, 1, 1)), atol=1e-6)


def test_turns_go_with_the_frames_of_reference():
    """Both sides turned alike: the same turns, seen from there."""
    target = eyeglasses(0, bend=GlassesBend(8, 2)).keypoints
    plain = turned_translations(POINTS, target)[:, :3, :3]
    world = random_rotation(np.random.default_rng(4))
    turned = turned_translations(POINTS @ world.T, target @ world.T)[:, :3, :3]
    assert_allclose(turned, world @ plain @ world.T, atol=1e-10)


def test_bones_with_missing_ends_do_not_count():
    target = POINTS + [1.0, 2, 3]
    target[[4, 11]] = np.nan
    found = turned_translations(POINTS, target)
    kept = np.isfinite(target).all(1)
    assert_allclose(found[kept, :3, :3], np.tile(np.eye(3), (18, 1, 1)), atol=1e-12)
    assert_allclose(carried(found, POINTS)[kept], target[kept], atol=1e-12)


def test_what_nothing_fixes_stays():
    """A straight temple without its hinge: no bone says how it is turned about itself."""
    temple = [KEY_POINT_NAMES.index(f"left_{name}") for name in ("temple_middle", "ear_bend", "temple_tip")]
    points = np.full((20, 3), np.nan)
    points[[2, 3, 4, 5, 6]] = POINTS[[2, 3, 4, 5, 6]]
    points[temple] = [[70.0, 11, -60], [70, 11, -120], [70, 11, -150]]
    target = points.copy()
    target[temple] += [[0.0, 0, 0], [2, 0, 0], [3, 0, 0]]
    found = turned_translations(points, target)[temple]
    assert_allclose(carried(found, points[temple]), target[temple], atol=1e-11)
    spread = rotation_from_vector([0, np.arctan2(-2, 60), 0])
    assert_allclose(found[:, :3, :3], np.tile(spread, (3, 1, 1)), atol=2e-3)
