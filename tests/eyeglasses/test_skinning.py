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


@pytest.fixture
def shares():
    raw = np.random.default_rng(0).random((20, 3))
    return raw / raw.sum(1, keepdims=True)


@pytest.fixture
def points():
    return np.random.default_rng(1).normal(size=(20, 3))


def affine(seed):
    rng = np.random.default_rng(seed)
    return compose(np.eye(3) + 0.3 * rng.normal(size=(3, 3)), rng.normal(size=3))


def test_one_transform_for_all_is_that_transform(points, shares):
    move = compose(rotation_from_vector([0.3, -0.2, 0.9]), [1, 2, 3])
    for maps in (np.stack([move] * 3), np.stack([move[:3]] * 3)):
        moved = skin(points, shares, maps)
        assert_allclose(moved, transform_points(move, points), atol=1e-12)


def test_vertices_are_means_of_where_the_handles_would_take_them(points, shares):
    maps = np.stack([affine(k) for k in range(3)])
    each = np.stack([transform_points(m, points) for m in maps], 1)
    assert_allclose(skin(points, shares, maps), np.einsum("vk,vki->vi", shares, each), atol=1e-12)


def test_shapes_that_do_not_fit_are_named(points, shares):
    maps = np.stack([np.eye(4)] * 3)
    with pytest.raises(ValueError, match=r"vertices is \(3,\), expected \(V, 3\)"):
        skin(points[0], shares, maps)
    with pytest.raises(ValueError, match=r"transforms is \(3, 3, 3\), expected \(K, R, 4\)"):
        skin(points, shares, maps[:, :3, :3])
    with pytest.raises(ValueError, match=r"weights is .* expected \(20, 2\)"):
        skin(points, shares, maps[:2])


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
    for name in ("left_temple_tip", "left_ear_bend", "left_rim_outer", "left_rim_top"):
        assert_allclose(found[KEY_POINT_NAMES.index(name), :3, :3], turn, atol=5e-3)
    assert_allclose(found[KEY_POINT_NAMES.index("right_rim_top"), :3, :3], np.eye(3), atol=5e-3)


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
