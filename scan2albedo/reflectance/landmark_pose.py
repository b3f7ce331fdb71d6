"""The pose of a face from landmarks in one image."""

from __future__ import annotations

import numpy as np

from scan2albedo.core.arrays import FloatArray
from scan2albedo.errors import ReflectanceError
from scan2albedo.geometry.pinhole import camera_centers, pixel_directions
from scan2albedo.geometry.rigid import compose, procrustes, rotation_from_vector, transform_points

LEAST_FOR_POSE, _ITERATIONS = 6, 200
_STARTS_DEG = ((0.0, 0.0), (0.0, 45.0), (0.0, -45.0), (35.0, 0.0), (-35.0, 0.0))
"""Pitch and yaw that the first rotation is turned by: flat sets of points have two minima."""


def pose_from_landmarks(camera: FloatArray, points_mm: FloatArray, pixels: FloatArray) -> FloatArray:
    """Return the rigid transform (4, 4), scene from model, that puts points on their lines of sight.

    Minimises the sum over points of the squared distance to the line of sight by orthogonal iteration [1]_:
    with the projections V_i = d_i d_i^T onto lines of sight, the best translation is linear in the rotation,
    and the rotation is the Procrustes one from points to their projections.

    Takes a normalised camera (3, 4), four or more points (N, 3) in mm that are not on a line, and their
    pixels (N, 2). Raises `ReflectanceError` when the pixels coincide, or no pose found has the points in
    front of the camera.

    .. [1] C.-P. Lu, G. Hager, E. Mjolsness, "Fast and Globally Convergent Pose Estimation from Video Images",
       IEEE PAMI 22(6), 2000.
    """
    if not np.ptp(pixels, axis=0).max() > 0:
        raise ReflectanceError("all landmarks lie in one point of the image; check them")
    center = points_mm.mean(0)
    local = points_mm - center
    directions = pixel_directions(camera, pixels)
    # Where lines of sight cross a plane in front of the camera: a weak-perspective picture.
    axis = directions.mean(0) / np.linalg.norm(directions.mean(0))
    first = procrustes(local, directions / (directions @ axis)[:, None], scale=True)
    upright = first[:3, :3] / np.cbrt(np.linalg.det(first[:3, :3]))
    onto = directions[:, :, None] * directions[:, None, :]
    off = onto - np.eye(3)
    to_translation = -np.linalg.inv(off.sum(0))
    best, least = np.eye(4), np.inf
    for pitch, yaw in np.radians(_STARTS_DEG):
        rotation = upright @ rotation_from_vector([0, yaw, 0]) @ rotation_from_vector([pitch, 0, 0])
        before = np.inf
        for _ in range(_ITERATIONS):
            shift = to_translation @ np.einsum("nij,nj->i", off, local @ rotation.T)
            pose = compose(rotation, shift)
            target = np.einsum("nij,nj->ni", onto, transform_points(pose, local))
            error = float(np.sum((transform_points(pose, local) - target) ** 2))
            if not error < before * (1 - 1e-6):
                break
            before = error
            rotation = procrustes(local, target)[:3, :3]
        ahead = (transform_points(pose, local) * directions).sum(1) > 0
        if ahead.all() and error < least:
            best, least = pose, error
    if not np.isfinite(least):
        raise ReflectanceError(
            "no pose puts the landmarks in front of the camera; check landmarks and camera"
        )
    to_scene = compose(np.eye(3), camera_centers(camera[None])[0])
    return np.asarray(to_scene @ best @ compose(np.eye(3), -center))
