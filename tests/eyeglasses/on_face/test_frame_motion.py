"""Derivatives of a moving, bending frame against differences, and covariances that follow from them."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.eyeglasses.on_face.frame_motion import FrameMotion, FrameState, SkinnedPoints, bend_prior
from scan2albedo.eyeglasses.skinning import PRIOR, known_bones, skin, turned_translations
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.rigid import random_rotation, rotation_from_vector
from scan2albedo.synthetic import eyeglasses

POINTS = eyeglasses(1).rest_keypoints
STEP = 1e-5


def scene(missing):
    """A bent frame with 30 points, random weights, slopes, values and votes."""
    rng = np.random.default_rng(0)
    keypoints, weights = POINTS.copy(), rng.dirichlet(np.ones(20), 30)
    shifts = rng.normal(0, 2, (20, 3))
    if missing:
        keypoints[[3, 10]] = np.nan
        shifts[[3, 10]] = 0
        weights[:, [3, 10]] = 0
        weights /= weights.sum(1, keepdims=True)
    state = FrameState(rotation_from_vector([0.3, 0.2, -0.4]), np.array([3.0, 4, 5]), shifts)
    return keypoints, state, SkinnedPoints(rng.normal(0, 40, (30, 3)), weights), rng


def differences(function, keypoints, state, steps):
    """Central differences (..., N) of a function of a motion along steps (N, P) of its state."""

    def at(step):
        return function(FrameMotion(keypoints, state.moved(step)))

    return np.stack([at(STEP * step) - at(-STEP * step) for step in steps], -1) / (2 * STEP)


@pytest.mark.parametrize("missing", [False, True])
def test_rows_are_the_derivatives(missing):
    keypoints, state, points, rng = scene(missing)
    slopes, motion = rng.normal(size=(30, 3)), FrameMotion(keypoints, state)
    place = motion.positions(points)
    rows = motion.rows(points, place, slopes)
    moves = differences(lambda moved: moved.positions(points), keypoints, state, np.eye(66))
    assert np.abs(rows).max() > 50
    assert_allclose(rows, np.einsum("vip,vi->vp", moves, slopes), atol=2e-7 * np.abs(rows).max())
    assert_array_equal(motion.rows(points, place, slopes, rigid=True), rows[:, :6])


@pytest.mark.parametrize("parameters", [6, 66])
def test_covariances_are_those_of_differences(parameters):
    keypoints, state, points, rng = scene(missing=True)
    motion, root = FrameMotion(keypoints, state), rng.normal(size=(parameters, parameters))
    spread = differences(lambda moved: moved.positions(points), keypoints, state, root.T)
    expected = spread @ spread.transpose(0, 2, 1)
    assert_allclose(motion.covariances(points, root), expected, atol=1e-6 * np.abs(expected).max())


def test_positions_are_those_of_skinning_and_a_step_of_turn_and_translation_is_a_rigid_motion():
    keypoints, state, points, _ = scene(False)
    motion = FrameMotion(keypoints, state)
    before = motion.positions(points)
    assert_allclose(before, skin(points.rest, points.weights, motion.transforms), atol=1e-11)
    turn = np.array([0.1, -0.2, 0.3])
    after = FrameMotion(keypoints, state.moved(np.concatenate([turn, [1.0, 2, 3]]))).positions(points)
    expected = (before - state.origin) @ rotation_from_vector(turn).T + state.origin + [1, 2, 3]
    assert_allclose(after, expected, atol=1e-11)


def by_decompositions(source, target, rounds=400):
    """The rotations of `turned_translations` by plain sweeps of singular value decompositions."""
    k, j = known_bones(source + target).T
    before, after = (normalized(points[j] - points[k]) for points in (source, target))
    turns, share = np.zeros((20, 3, 3)), np.zeros((20, 20))
    np.add.at(turns, k, after[:, :, None] * before[:, None, :])
    degree = np.bincount(k, minlength=20)
    turns[degree == 0] = np.eye(3)
    share[k, j] = PRIOR / degree[k]
    rotations = np.tile(np.eye(3), (20, 1, 1))
    for _ in range(rounds):
        u, _, vt = np.linalg.svd(turns + np.einsum("kj,jab->kab", share, rotations))
        u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
        rotations = u @ vt
    return rotations


@pytest.mark.parametrize("size", [0.1, 2.0, 10.0, 40.0])
@pytest.mark.parametrize("turned", [False, True])
def test_rotations_are_those_of_decompositions(size, turned):
    rng = np.random.default_rng(3)
    target = POINTS + rng.normal(0, size, POINTS.shape)
    if turned:
        target = target @ random_rotation(rng).T
    target[[3, 11]] = np.nan
    found = turned_translations(POINTS, target)[:, :3, :3]
    assert_allclose(found, by_decompositions(POINTS, target), atol=1e-11)


def test_the_priors_derivatives_hold_where_turns_are_small():
    state = FrameState(np.eye(3), np.zeros(3), np.random.default_rng(1).normal(0, 0.02, (20, 3)))
    _, rows = bend_prior(FrameMotion(POINTS, state))
    steps = np.eye(66)[6:]
    expected = differences(lambda moved: bend_prior(moved)[0], POINTS, state, steps)
    assert_allclose(rows @ steps.T, expected, atol=2e-3 * np.abs(rows).max(), rtol=0.02)
    at_rest = FrameState(np.eye(3), np.zeros(3), np.zeros((20, 3)))
    assert_allclose(bend_prior(FrameMotion(POINTS, at_rest))[0], 0, atol=1e-9)
