"""Pose of a rigid face from landmarks: any pose, noise, few points."""

import numpy as np
import pytest
from helpers.measures import rms

from scan2albedo import AnnotatedFaceModel
from scan2albedo.geometry.pinhole import look_at, project
from scan2albedo.geometry.rigid import compose, rotation_angle_rad, rotation_from_vector, transform_points
from scan2albedo.reflectance.geometry_fit import pose_from_landmarks

POINTS = AnnotatedFaceModel.default().landmarks
CAMERA = look_at([100, 50, 700], [0, 0, 0], focal_px=1800, shape=(800, 800))


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("count", [68, 8])
def test_poses_are_found_again(seed, count):
    rng = np.random.default_rng(seed)
    chosen = np.sort(rng.permutation(68)[:count])
    turn = rotation_from_vector(rng.uniform(-1, 1, 3) * [0.6, 1.2, 0.8])
    truth = compose(turn, rng.normal(size=3) * [40, 40, 80])
    pixels, _ = project(CAMERA, transform_points(truth, POINTS[chosen]))
    exact = pose_from_landmarks(CAMERA, POINTS[chosen], pixels)
    assert np.degrees(rotation_angle_rad(exact[:3, :3] @ turn.T)) < 1.5
    noisy = pose_from_landmarks(CAMERA, POINTS[chosen], pixels + rng.normal(size=pixels.shape))
    again, depth = project(CAMERA, transform_points(noisy, POINTS[chosen]))
    assert (depth > 0).all()
    assert rms(again - pixels) < 1.5


def test_an_upside_down_face_is_found():
    truth = compose(rotation_from_vector([0, 0, np.pi]), [0, 0, 0])
    pixels, _ = project(CAMERA, transform_points(truth, POINTS))
    found = pose_from_landmarks(CAMERA, POINTS, pixels)
    assert np.degrees(rotation_angle_rad(found[:3, :3] @ truth[:3, :3].T)) < 0.5
