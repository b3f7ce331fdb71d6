"""Landmarks that someone placed show where the face is, also when one of them is wrong."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.poses import assert_near
from worlds.stereo import StereoScanner, stereo_scan

from scan2albedo import register
from scan2albedo.errors import NoFaceError
from scan2albedo.geometry.rigid import (
    Similarity,
    invert_rigid,
    random_rotation,
    transform_points,
)
from scan2albedo.registration.coarse_search import PlacedPose

FIVE = [36, 45, 30, 48, 54]


def placed(points):
    """Return five landmarks of 68, and NaN for the others."""
    chosen = np.full((68, 3), np.nan)
    chosen[FIVE] = points[FIVE]
    return chosen


@pytest.fixture
def posed(model):
    rng = np.random.default_rng(3)
    pose = Similarity(random_rotation(rng), np.array([30.0, -200.0, 90.0]), 0.9)
    return pose, pose.apply(model.landmarks) + rng.normal(scale=2, size=(68, 3))


def found(model, of_scan, numbers=FIVE):
    return PlacedPose(model.landmarks[numbers], of_scan[numbers])


def test_the_pose_is_that_of_the_landmarks_and_one_wrong_landmark_hardly_moves_it(model, posed):
    pose, points = posed
    right = found(model, points).start()
    assert Similarity(right.rotations[0], pose.translation).is_near(pose, np.deg2rad(4), 1.0)
    points[54] += (15, 16, 12)
    off = found(model, points).start()
    assert np.linalg.norm(off.rotations[0] - right.rotations[0]) < 0.08
    assert np.linalg.norm(off.translations[0] - right.translations[0]) < 8


def test_they_speak_for_their_own_pose_only(model, posed):
    pose, points = posed
    witness = found(model, points)
    assert witness.log_odds(pose) > 10
    upside_down = replace(pose, rotation=pose.rotation @ np.diag([-1.0, -1.0, 1.0]))
    assert witness.log_odds(upside_down) == -2.0
    points[30] += (15, 16, 12)
    assert 5 < found(model, points).log_odds(pose) < witness.log_odds(pose)


@pytest.mark.parametrize("numbers", [[30], [36, 45], [27, 28]])
def test_too_few_or_points_in_a_line_show_no_pose(model, numbers):
    assert found(model, model.landmarks, numbers).triples() == []


@pytest.mark.slow
def test_a_capture_too_poor_to_show_a_face_is_let_in_by_landmarks(model):
    scanner = StereoScanner(noise_mm=(1.5, 6.0), holes=(15, 60), reach_mm=(45.0, 170.0))
    scan, truth = stereo_scan(105_020, scanner=scanner)
    with pytest.raises(NoFaceError):
        register(scan, model)
    scan_from_model = invert_rigid(truth.model_from_scan)
    points = transform_points(scan_from_model, truth.landmarks)
    reg = register(replace(scan, landmarks=placed(points)), model)
    assert reg.confidence > 0.9
    assert_near(reg.model_from_scan, truth.model_from_scan, 8, np.inf)
    with pytest.raises(NoFaceError):  # numbers in another order
        register(replace(scan, landmarks=placed(points[::-1])), model)


def test_landmarks_of_another_scan_do_not_refuse_a_face(model):
    scan, _ = stereo_scan(3)
    nonsense = np.random.default_rng(0).normal(scale=80, size=(68, 3))
    assert register(replace(scan, landmarks=nonsense), model).confidence > 0.9
