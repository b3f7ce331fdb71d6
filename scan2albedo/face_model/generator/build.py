"""Make the default model from measurements."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from scan2albedo.face_model.generator.anthropometry import Measurements
from scan2albedo.face_model.generator.key_points import half_face
from scan2albedo.face_model.generator.landmarks import LEFT_TO_RIGHT, MIDDLE, half_landmarks
from scan2albedo.face_model.generator.layout import layout_of, mirrored_mesh
from scan2albedo.face_model.generator.meshing import HalfMesh, MeshOptions, mesh_half
from scan2albedo.face_model.generator.regions import MIDDLE_REGIONS, default_regions, half_region_names
from scan2albedo.face_model.model import LANDMARK_LEVELS, AnnotatedFaceModel
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.loop_subdivision import LoopSubdivision, SurfacePoints, limit_matrix
from scan2albedo.geometry.mesh import face_areas
from scan2albedo.geometry.parametrization import parametrize_disc

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

CURVE_EDGE_MM = {
    "upper_lid": 3.6,
    "lower_lid": 3.6,
    "upper_vermilion": 4.0,
    "mouth_line": 4.0,
    "lower_vermilion": 4.0,
    "alar_crease": 3.2,
}
"""Edge lengths along the features on which vertices are spent."""


def build_face_model(measurements: Measurements | None = None) -> AnnotatedFaceModel:
    """Make an annotated face model with the given (by default average) measurements.

    Key points of half a face are laid out in a plane, meshed along the feature curves, lifted by a
    thin-plate spline, mirrored, and the control vertices P solved from ``L P = X`` with L the Loop limit
    matrix, so that the limit surface passes through the lifted points X.

    Notes
    -----
    Deterministic; a few seconds.
    """
    half = half_face(Measurements() if measurements is None else measurements)
    layout = layout_of(half)
    curves = {name: layout.place(curve) for name, curve in half.curves.items()}
    mesh = mesh_half(curves, ("midline", "outline"), MeshOptions(CURVE_EDGE_MM))
    on_middle = mesh.flat[:, 0] < 1e-9
    flat, faces, mirror = mirrored_mesh(mesh.flat, mesh.faces, on_middle)
    lifted = layout.lift(flat)
    lifted = 0.5 * (lifted + lifted[mirror] * [-1, 1, 1])
    control = splu(limit_matrix(len(lifted), faces).tocsc()).solve(lifted)
    control = 0.5 * (control + control[mirror] * [-1, 1, 1])
    center = _centroid(control, faces)
    regions = default_regions()
    lifted_curves = {name: lifted[index] for name, index in mesh.curves.items()}
    return AnnotatedFaceModel(
        control - center,
        faces,
        parametrize_disc(lifted, faces, mirror=mirror),
        _region_of_faces(lifted, mesh, lifted_curves, {r.name: r.index for r in regions.values()}),
        regions,
        landmark_points=_landmark_points(control, faces, lifted_curves),
        name="default annotated face model",
    )


def _centroid(control: FloatArray, faces: IntArray) -> FloatArray:
    """Return the area centroid of the limit surface, x exactly 0."""
    subdivision = LoopSubdivision.of(len(control), faces, 2)
    surface = subdivision.matrix @ control
    center = np.average(
        surface[subdivision.faces].mean(1), axis=0, weights=face_areas(surface, subdivision.faces)
    )
    return center * [0, 1, 1]


def _region_of_faces(
    lifted: FloatArray, mesh: HalfMesh, curves: dict[str, FloatArray], index: dict[str, int]
) -> NDArray[np.uint8]:
    names = half_region_names(lifted[mesh.faces].mean(1), curves)
    sided = [
        [index[n if n in MIDDLE_REGIONS else f"{side}_{n}"] for n in names] for side in ("left", "right")
    ]
    return np.array(sided[0] + sided[1], np.uint8)


def _landmark_points(control: FloatArray, faces: IntArray, curves: dict[str, FloatArray]) -> SurfacePoints:
    """Return the 68 landmarks: closest points of the limit surface, the right half mirrored."""
    targets = half_landmarks(curves)
    numbers = sorted(targets)
    subdivision = LoopSubdivision.of(len(control), faces, LANDMARK_LEVELS)
    left = len(subdivision.faces) // 2
    hits = ClosestPointQuery(subdivision.matrix @ control, subdivision.faces[:left]).query(
        np.stack([targets[n] for n in numbers])
    )
    found = subdivision.control_points(SurfacePoints(hits.face, hits.barycentric))
    face, weights = np.zeros(68, np.int64), np.zeros((68, 3))
    face[numbers], weights[numbers] = found.face, found.barycentric
    for middle in MIDDLE:
        weights[middle] = _on_midline(weights[middle], np.abs(control[faces[face[middle]], 0]) < 1e-9)
    for left_number, right_number in LEFT_TO_RIGHT:
        # The mirror image of face f is f + F / 2 with its last two corners swapped.
        face[right_number] = face[left_number] + len(faces) // 2
        weights[right_number] = weights[left_number][[0, 2, 1]]
    return SurfacePoints(face, weights)


def _on_midline(weights: FloatArray, corner_on_midline: NDArray[np.bool_]) -> FloatArray:
    kept = np.where(corner_on_midline, weights, 0.0)
    return kept / kept.sum()
