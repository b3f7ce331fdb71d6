"""A real frame of 25 loose parts, in metres, bent by known shifts and found again from its pictures."""

import numpy as np
import pytest
from benchmarks.eyeglasses_scenes import hand_placed

from scan2albedo.eyeglasses import bounded_biharmonic_weights, register_on_face
from scan2albedo.eyeglasses.on_face.frame_motion import FrameMotion, FrameState, SkinnedPoints
from scan2albedo.geometry.pinhole import look_at, project
from scan2albedo.geometry.rigid import rotation_from_vector
from scan2albedo.io import load_scan
from scan2albedo.rendering.pictures import seen_samples

pytestmark = pytest.mark.slow
SHAPE = (1024, 1024)


def test_sunglasses_of_many_parts_are_found_again(shared_data):
    scan = load_scan(shared_data / "sunglasses_khronos.glb")
    marks = hand_placed(scan.vertices)
    weights = bounded_biharmonic_weights(scan.vertices, scan.faces, marks)
    shifts = np.zeros((20, 3))
    behind = marks[:, 2].max() - marks[:, 2]
    way = np.clip((behind - 25) / (behind.max() - 25), 0, 1)
    shifts[:, 0] = 10 * np.sign(marks[:, 0]) * way**2 * (3 - way) / 2
    state = FrameState(rotation_from_vector([0.2, -0.3, 0.1]), np.array([10.0, 5, -8]), shifts)
    truth = FrameMotion(marks, state)
    vertices = truth.positions(SkinnedPoints(scan.vertices, weights))
    target = np.array([10.0, 5, -50])
    cameras, masks, labels = [], [], []
    rng = np.random.default_rng(0)
    for yaw in (-0.65, 0.0, 0.65):
        position = target + 600 * np.array([np.sin(yaw), 0.13, np.cos(yaw)])
        cameras.append(look_at(position, target, focal_px=1800, shape=SHAPE))
        masks.append(np.zeros(SHAPE, bool))
        masks[-1].flat[seen_samples(vertices, scan.faces, cameras[-1], SHAPE).index] = True
        seen = project(cameras[-1], truth.positions(SkinnedPoints(marks, np.eye(20))))[0]
        labels.append(seen + rng.normal(0, 1, (20, 2)))
    found = register_on_face((scan.vertices, scan.faces, marks, weights), labels, masks, cameras)
    errors = np.linalg.norm(found.vertices - vertices, axis=1)
    assert np.sqrt((errors**2).mean()) <= 0.35
    assert errors.max() <= 1.2
    assert found.iou.min() > 0.98
    assert found.unobserved == ()
