"""A real frame of 25 loose parts, in metres, bent by known shifts and found again from its pictures."""

import numpy as np
import pytest

from scan2albedo.eyeglasses import KEY_POINT_NAMES, bounded_biharmonic_weights, register_on_face
from scan2albedo.eyeglasses.on_face.frame_motion import FrameMotion, FrameState, SkinnedPoints
from scan2albedo.eyeglasses.on_face.outline import cover
from scan2albedo.geometry.pinhole import look_at, project
from scan2albedo.geometry.rigid import rotation_from_vector
from scan2albedo.io import load_scan

pytestmark = pytest.mark.slow
SHAPE = (1024, 1024)


def key_points(vertices):
    """Twenty named vertices: near places of the front's halves, in the middle of slices of the temples."""
    low, high = vertices.min(0), vertices.max(0)
    middle, width, depth = (low[0] + high[0]) / 2, (high[0] - low[0]) / 2, high[2] - low[2]
    back = (high[2] - vertices[:, 2]) / depth

    def nearest(place, where):
        chosen = np.flatnonzero(where)
        return vertices[chosen[np.linalg.norm(vertices[chosen] - place, axis=1).argmin()]]

    points = {}
    for side, sign in (("left", 1), ("right", -1)):
        outward = sign * (vertices[:, 0] - middle) / width
        half = (back < 0.2) & (outward > 0)
        bottom, top = vertices[half, 1].min(), vertices[half, 1].max()
        for name, x, y, z in (
            ("rim_top", 0.52, 1.0, 0.0),
            ("rim_bottom", 0.5, 0.0, 0.0),
            ("rim_bridge", 0.14, 0.8, 0.0),
            ("rim_inner", 0.16, 0.4, 0.0),
            ("rim_outer", 0.93, 0.5, 0.05),
            ("hinge", 1.0, 0.85, 0.12),
        ):
            place = [middle + sign * x * width, bottom + y * (top - bottom), high[2] - z * depth]
            points[f"{side}_{name}"] = nearest(place, half | (outward > 0.6))
        for name, way in (("temple_middle", 0.45), ("ear_bend", 0.72), ("temple_tip", 1.0)):
            part = (outward > 0.6) & (np.abs(back - way) < 0.04)
            points[f"{side}_{name}"] = nearest(vertices[part].mean(0), part)
    bridge = vertices[(back < 0.2) & (np.abs(vertices[:, 0] - middle) < 0.16 * width)]
    points["bridge_top"] = bridge[bridge[:, 1].argmax()]
    points["bridge_bottom"] = bridge[bridge[:, 1].argmin()]
    return np.array([points[name] for name in KEY_POINT_NAMES])


def test_sunglasses_of_many_parts_are_found_again(shared_data):
    scan = load_scan(shared_data / "sunglasses_khronos.glb")
    marks = key_points(scan.vertices)
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
        pixels, depth = project(cameras[-1], vertices)
        covered = cover(pixels, depth, scan.faces, SHAPE)
        masks.append(np.zeros(SHAPE, bool))
        row, column = covered.corner
        height, width = covered.face.shape
        masks[-1][row : row + height, column : column + width] = covered.face >= 0
        seen = project(cameras[-1], truth.positions(SkinnedPoints(marks, np.eye(20))))[0]
        labels.append(seen + rng.normal(0, 1, (20, 2)))
    found = register_on_face((scan.vertices, scan.faces, marks, weights), labels, masks, cameras)
    errors = np.linalg.norm(found.vertices - vertices, axis=1)
    assert np.sqrt((errors**2).mean()) <= 0.35
    assert errors.max() <= 1.2
    assert found.iou.min() > 0.98
    assert found.unobserved == ()
