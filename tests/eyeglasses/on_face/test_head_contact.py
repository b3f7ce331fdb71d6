"""The frame's distance from the head, by its nearest or deepest point."""

import numpy as np
import pytest
from helpers.eyeglasses import nearest_weights
from helpers.plates import FACES, plate
from numpy.testing import assert_allclose

from scan2albedo.eyeglasses.mean_keypoints import BEHIND, FRONT
from scan2albedo.eyeglasses.on_face.frame_motion import FrameMotion, FrameState, SkinnedPoints
from scan2albedo.eyeglasses.on_face.objective import HeadContact
from scan2albedo.synthetic import eyeglasses

GLASSES = eyeglasses(0)
POINTS = SkinnedPoints(GLASSES.rest_vertices, nearest_weights(GLASSES.rest_vertices, GLASSES.rest_keypoints))
WALL = plate(200, 0.0).vertices, FACES
"""A face without features that looks along +z."""


@pytest.mark.parametrize("gap", [5.0, 0.3, -2.0])
def test_the_gap_is_that_of_the_fronts_hindmost_point(gap):
    lowest = GLASSES.rest_vertices[FRONT[POINTS.weights.argmax(1)], 2].min()
    marks = GLASSES.rest_keypoints
    state = FrameState(np.eye(3), marks.mean(0) + [0, 0, gap - lowest], np.zeros((20, 3)))
    contact, motion = HeadContact(POINTS, *WALL), FrameMotion(marks, state)
    contact.select_candidates(motion)
    point, place, distance, slope = contact.nearest_point(motion)
    assert distance == pytest.approx(gap, abs=1e-9)
    assert place[0, 2] == pytest.approx(gap, abs=1e-9)
    assert_allclose(slope, [[0, 0, 1]], atol=1e-9)
    assert_allclose(motion.positions(point), place)


def test_a_frame_of_temples_alone_touches_nothing():
    only = POINTS[np.flatnonzero(BEHIND[POINTS.weights.argmax(1)])]
    assert not HeadContact(only, *WALL)
    assert HeadContact(POINTS, *WALL)
