"""The landmarks and the initial state that `refine_geometry` starts from."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scan2albedo.errors import ReflectanceError
from scan2albedo.geometry.mesh import edges_with_faces
from scan2albedo.geometry.pinhole import project
from scan2albedo.reflectance.geometry_options import GeometryFitOptions
from scan2albedo.reflectance.geometry_search import GeometryState
from scan2albedo.reflectance.geometry_terms import LandmarkTerm
from scan2albedo.reflectance.pose_from_landmarks import pose_from_landmarks
from scan2albedo.reflectance.shape_model import LANDMARKS, MorphableShapeModel, checked_coefficients

FloatArray = NDArray[np.float64]

_CONTOUR = 17
"""Landmarks of the jaw's outline come first."""
_LEAST_FOR_POSE = 6


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
