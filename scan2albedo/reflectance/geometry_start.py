"""Where a geometry fit starts: its landmarks, and the pose and coefficients before the first step."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core.arrays import FloatArray
from scan2albedo.errors import ReflectanceError
from scan2albedo.geometry.mesh import edges_with_faces
from scan2albedo.geometry.pinhole import camera_centers, pixel_directions, project
from scan2albedo.geometry.rigid import compose, procrustes, rotation_from_vector, transform_points
from scan2albedo.reflectance.geometry_search import GeometryState
from scan2albedo.reflectance.geometry_terms import GeometryFitOptions, LandmarkTerm
from scan2albedo.reflectance.sample_statistics import checked_coefficients
from scan2albedo.reflectance.shape_model import LANDMARKS, MorphableShapeModel

_CONTOUR = 17
"""Landmarks of the jaw's outline come first."""
_LEAST_FOR_POSE = 6
_ITERATIONS = 200
_LEAST_SPAN_PX = 1e-3
_STARTS_DEG = ((0.0, 0.0), (0.0, 45.0), (0.0, -45.0), (35.0, 0.0), (-35.0, 0.0))
"""Pitch and yaw that the first rotation is turned by: flat sets of points have two minima."""


def checked_landmarks(landmarks_px: ArrayLike, contour: bool) -> FloatArray:
    """Return landmarks (68, 2), NaN in both where one is not seen, and along the jaw without `contour`."""
    landmarks = np.array(landmarks_px, np.float64)
    if landmarks.shape != (LANDMARKS, 2):
        raise ValueError(f"landmarks_px must have shape ({LANDMARKS}, 2), got {landmarks.shape}")
    landmarks[~np.isfinite(landmarks).all(1)] = np.nan
    if not contour:
        landmarks[:_CONTOUR] = np.nan
    return landmarks


def initial_state(
    camera: FloatArray,
    landmarks: FloatArray,
    model: MorphableShapeModel,
    pose: ArrayLike | None,
    identity: ArrayLike | None,
    expression: ArrayLike | None,
) -> GeometryState:
    """Return the initial state, its pose from landmarks where none is given."""
    a = np.zeros(model.identity_components) if identity is None else identity
    b = np.zeros(model.expression_components) if expression is None else expression
    a = checked_coefficients(a, model.identity_components, "initial_identity")
    b = checked_coefficients(b, model.expression_components, "initial_expression")
    if pose is not None:
        return GeometryState(_checked_pose(pose), a, b)
    seen = np.flatnonzero(np.isfinite(landmarks).all(1))
    if len(seen) < _LEAST_FOR_POSE:
        raise ReflectanceError(
            f"{len(seen)} landmarks are seen, and a pose takes {_LEAST_FOR_POSE}; give "
            "initial_scene_from_model"
        )
    points = model.shape(a, b)[model.landmark_vertices[seen]]
    return GeometryState(pose_from_landmarks(camera, points, landmarks[seen]), a, b)


def _checked_pose(pose: ArrayLike) -> FloatArray:
    matrix = np.array(pose, np.float64)
    if matrix.shape != (4, 4):
        raise ValueError(f"initial_scene_from_model must have shape (4, 4), got {matrix.shape}")
    turn = matrix[:3, :3]
    rigid = np.isfinite(matrix).all() and np.abs(turn @ turn.T - np.eye(3)).max() < 1e-6
    if not (rigid and np.linalg.det(turn) > 0 and np.array_equal(matrix[3], [0, 0, 0, 1])):
        raise ReflectanceError(
            "initial_scene_from_model is no rigid transform; give rotation and translation"
        )
    return matrix


def landmark_term(
    camera: FloatArray,
    landmarks: FloatArray,
    model: MorphableShapeModel,
    state: GeometryState,
    options: GeometryFitOptions,
) -> LandmarkTerm | None:
    """Return the term over the landmarks seen, None without any; their scale in mm is that of `state`."""
    seen = np.flatnonzero(np.isfinite(landmarks).all(1))
    if len(seen) == 0:
        return None
    vertex = model.landmark_vertices[seen]
    _, depth = project(camera, state.vertices(model)[vertex])
    if not (depth > 0).all():
        raise ReflectanceError("landmarks lie behind the camera at the initial pose; check pose and camera")
    return LandmarkTerm(
        camera,
        vertex,
        landmarks[seen],
        _pixel_mm(camera, depth),
        options.landmark_weight,
        options.landmark_softness_mm,
    )


def edge_px(camera: FloatArray, model: MorphableShapeModel, state: GeometryState) -> float:
    """Return the length of the mesh's mean edge in the image; 0 where the face is behind the camera."""
    vertices = state.vertices(model)
    edges, _ = edges_with_faces(model.faces)
    length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1).mean()
    _, depth = project(camera, vertices)
    return float(length / _pixel_mm(camera, depth)) if np.median(depth) > 0 else 0.0


def _pixel_mm(camera: FloatArray, depth: FloatArray) -> float:
    """Return the size of a pixel at the median depth."""
    return float(np.median(depth) / np.sqrt(abs(np.linalg.det(camera[:, :3]))))


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
    if not np.ptp(pixels, axis=0).max() > _LEAST_SPAN_PX:
        raise ReflectanceError("all landmarks lie in one point of the image; check them")
    center = points_mm.mean(0)
    local = points_mm - center
    directions = pixel_directions(camera, pixels)
    best, least = np.eye(4), np.inf
    for pitch, yaw in np.radians(_STARTS_DEG):
        first = procrustes(local, _plane_points(directions), scale=True)
        rotation = first[:3, :3] / np.cbrt(np.linalg.det(first[:3, :3]))
        turned = rotation @ rotation_from_vector([0, yaw, 0]) @ rotation_from_vector([pitch, 0, 0])
        pose, error = _iterate(local, directions, turned)
        if error < least:
            best, least = pose, error
    if not np.isfinite(least):
        raise ReflectanceError(
            "no pose puts the landmarks in front of the camera; check landmarks and camera"
        )
    to_scene = compose(np.eye(3), camera_centers(camera[None])[0])
    return np.asarray(to_scene @ best @ compose(np.eye(3), -center))


def _plane_points(directions: FloatArray) -> FloatArray:
    """Return where lines of sight cross a plane in front of the camera: a weak-perspective picture."""
    axis = directions.mean(0) / np.linalg.norm(directions.mean(0))
    return directions / (directions @ axis)[:, None]


def _iterate(points: FloatArray, directions: FloatArray, rotation: FloatArray) -> tuple[FloatArray, float]:
    """Return pose and error of orthogonal iteration, the camera at the origin."""
    onto = directions[:, :, None] * directions[:, None, :]
    off = onto - np.eye(3)
    to_translation = -np.linalg.inv(off.sum(0))
    before = np.inf
    for _ in range(_ITERATIONS):
        shift = to_translation @ np.einsum("nij,nj->i", off, points @ rotation.T)
        pose = compose(rotation, shift)
        target = np.einsum("nij,nj->ni", onto, transform_points(pose, points))
        error = float(np.sum((transform_points(pose, points) - target) ** 2))
        if not error < before * (1 - 1e-6):
            break
        before = error
        rotation = procrustes(points, target)[:3, :3]
    behind = (transform_points(pose, points) * directions).sum(1) <= 0
    return pose, np.inf if behind.any() else error
