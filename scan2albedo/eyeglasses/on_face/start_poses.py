"""First poses of a frame, and whether left and right are exchanged."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from scan2albedo.core import Meter
from scan2albedo.core.arrays import FloatArray
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.keypoints import MIRROR
from scan2albedo.eyeglasses.on_face.frame_motion import FrameState
from scan2albedo.eyeglasses.on_face.interface import FaceRegistrationOptions
from scan2albedo.eyeglasses.on_face.objective import (
    ObservedView,
    RegistrationObjective,
    descend,
    median_label_px,
)
from scan2albedo.eyeglasses.on_face.registration_inputs import RegistrationInputs
from scan2albedo.eyeglasses.on_face.triangulation import triangulate
from scan2albedo.geometry.rigid import compose, procrustes

_FEWEST = 4
"""Labels of one view that fix a pose."""
_OTHER_UNIT = 3.0
"""Ratio of sizes from which the frame and the cameras cannot be in the same unit."""
_INLIER_PX = 8.0
"""Distance up to which a label agrees with a view's pose."""
_DRAWS = 300
_MIRRORED = 0.5
"""Part of the labels' error below which exchanging left and right explains them."""


def starting_poses(
    keypoints: FloatArray, views: tuple[ObservedView, ...], noise_px: float, given: FloatArray | None
) -> list[FrameState]:
    """Return at least one unbent state to start from, of a frame with key points (K, 3) at rest.

    Poses come from triangulated key points, from each view alone, and from the caller (`given`). Raises
    EyeglassesError when the labels fix no pose and none was given, or the units of frame and cameras differ.
    """
    poses = [] if given is None else [given]
    poses += _triangulated(keypoints, views, noise_px)
    poses += [pose for view in views if (pose := _from_one_view(keypoints, view)) is not None]
    if not poses:
        labelled = [int(np.isfinite(view.labels).all(1).sum()) for view in views]
        remedy = "label 4 or more in one view, 3 or more in two, or give a start"
        if max(labelled) >= _FEWEST:
            remedy = (
                "they contradict one another or the cameras; check labels, order and cameras, or give a start"
            )
        raise EyeglassesError(
            f"the key points labelled in the views ({', '.join(map(str, labelled))}) fix no pose: {remedy}"
        )
    known = np.isfinite(keypoints).all(1)
    center = keypoints[known].mean(0)
    still = np.zeros_like(keypoints)
    return [FrameState(pose[:3, :3], pose[:3, :3] @ center + pose[:3, 3], still) for pose in poses]


def _triangulated(
    keypoints: FloatArray, views: tuple[ObservedView, ...], noise_px: float
) -> list[FloatArray]:
    labels, cameras = np.stack([v.labels for v in views]), np.stack([v.camera for v in views])
    found = triangulate(labels, cameras, noise_px=noise_px)
    good = np.isfinite(found.points).all(1) & np.isfinite(keypoints).all(1) & (found.inliers.sum(0) >= 2)
    if good.sum() < 3:
        return []
    world, rest = found.points[good], keypoints[good]
    ratio = _spread(world) / _spread(rest)
    if not 1 / _OTHER_UNIT < ratio < _OTHER_UNIT:
        raise EyeglassesError(
            f"the labels make a frame {ratio:.3g} times as large as the one given: bring glasses and cameras "
            "to the same unit"
        )
    # A line of key points leaves a turn open.
    if np.linalg.svd(rest - rest.mean(0), compute_uv=False)[1] < 1e-3 * _spread(rest):
        return []
    return [procrustes(rest, world)]


def _spread(points: FloatArray) -> float:
    return float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))


def _from_one_view(keypoints: FloatArray, view: ObservedView) -> FloatArray | None:
    """Return the pose that most labels of one view agree with, by RANSAC over perspective-n-point."""
    import cv2

    seen = np.isfinite(view.labels).all(1) & np.isfinite(keypoints).all(1)
    if seen.sum() < _FEWEST:
        return None
    intrinsic, rotation = _factors(view.camera[:, :3])
    plane = np.linalg.solve(intrinsic, np.column_stack([view.labels[seen], np.ones(seen.sum())]).T).T
    cv2.setRNGSeed(0)
    try:
        found, turn, shift, _ = cv2.solvePnPRansac(
            np.ascontiguousarray(keypoints[seen]),
            np.ascontiguousarray(plane[:, :2] / plane[:, 2:]),
            np.eye(3),
            None,
            iterationsCount=_DRAWS,
            reprojectionError=float(_INLIER_PX / np.sqrt(abs(np.linalg.det(intrinsic[:2, :2])))),
            flags=cv2.SOLVEPNP_SQPNP,
        )
    except cv2.error:
        # Labels in one spot, or seen from very far: this view alone fixes no pose.
        return None
    if not found or not (np.isfinite(turn).all() and np.isfinite(shift).all()):
        return None
    camera_from_frame = compose(cv2.Rodrigues(turn)[0], shift[:, 0])
    offset = np.linalg.solve(intrinsic, view.camera[:, 3])
    world_from_camera = compose(rotation.T, -rotation.T @ offset)
    return world_from_camera @ camera_from_frame


def _factors(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the upper triangular intrinsic matrix (3, 3), last entry 1, and the rotation (3, 3)."""
    from scipy.linalg import rq

    intrinsic, rotation = rq(matrix)
    signs = np.sign(np.diag(intrinsic))
    return intrinsic * signs, signs[:, None] * rotation


def require_unmirrored(given: RegistrationInputs, options: FaceRegistrationOptions, error_px: float) -> None:
    """Raise EyeglassesError where exchanging left and right explains the labels far better.

    `error_px` is their error as they are, at the best pose.
    """
    views = tuple(replace(view, labels=view.labels[list(MIRROR)]) for view in given.views)
    objective = RegistrationObjective(given.keypoints, views, options)
    rigid = partial(objective.linearize, samples=None, rigid=True)
    try:
        starts = starting_poses(given.keypoints, views, options.label_noise_px, None)
    except EyeglassesError:
        return
    first = min(starts, key=lambda state: rigid(state).cost)
    found = descend(rigid, first, Meter("mirrored", "px"), error=median_label_px)
    mirrored_px = median_label_px(found.at)
    if mirrored_px < _MIRRORED * error_px:
        raise EyeglassesError(
            "left and right of the labels, or of the glasses' key points, seem to be exchanged: the pose "
            f"fits to {mirrored_px:.1f} px with them swapped, to {error_px:.1f} px as they are"
        )
