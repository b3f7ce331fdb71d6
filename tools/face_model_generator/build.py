"""Make the default model from measurements."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from face_model_generator.anthropometry import Measurements
from face_model_generator.key_points import half_face
from face_model_generator.landmarks import LEFT_TO_RIGHT, MIDDLE, half_landmarks
from face_model_generator.layout import FaceLayout, layout_of, mirrored_mesh
from face_model_generator.meshing import MeshOptions, mesh_half
from face_model_generator.mouth_slit import SlitMesh, with_mouth_slit
from face_model_generator.regions import (
    MIDDLE_REGIONS,
    default_regions,
    half_region_names,
    in_one_piece,
    without_spikes,
)
from scan2albedo import AnnotatedFaceModel
from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.face_model.annotation import LANDMARK_LEVELS, MOUTH_REGION
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.loop_subdivision import LoopSubdivision, SurfacePoints, limit_matrix
from scan2albedo.geometry.mesh import face_areas
from scan2albedo.geometry.parametrization import parametrize_disc

CURVE_EDGE_MM = {
    "upper_lid": 2.9,
    "lower_lid": 2.9,
    "upper_vermilion": 3.0,
    "mouth_line": 3.0,
    "lower_vermilion": 3.0,
    "upper_lip": 3.0,
    "lower_lip": 3.0,
    "alar_crease": 2.6,
    "nose_rim": 3.0,
}
"""Edge lengths along the features on which vertices are spent."""

FIT_LEVELS = 2
"""Refinements at whose vertices the limit surface is fitted to the design."""


def build_face_model(measurements: Measurements | None = None) -> AnnotatedFaceModel:
    """Make an annotated face model with the given (by default average) measurements.

    Key points of half a face are laid out in a plane, meshed along the feature curves, lifted by a
    thin-plate spline and mirrored; the control vertices follow from least squares, so that the Loop limit
    surface (not the control mesh, which it shrinks) is the designed one.

    Notes
    -----
    Deterministic; a few seconds.
    """
    half = half_face(Measurements() if measurements is None else measurements)
    layout = layout_of(half)
    curves = {name: layout.place(curve) for name, curve in half.curves.items()}
    slit = with_mouth_slit(mesh_half(curves, ("midline", "outline"), MeshOptions(CURVE_EDGE_MM)))
    mesh = slit.mesh
    on_middle = mesh.flat[:, 0] < 1e-9
    flat, faces, mirror = mirrored_mesh(mesh.flat, mesh.faces, on_middle)
    control = _symmetric(_control_vertices(layout, flat, faces), mirror)
    lifted = limit_matrix(len(control), faces) @ control
    center = _centroid(control, faces)
    regions = default_regions()
    lifted_curves = {name: lifted[index] for name, index in mesh.curves.items()}
    return AnnotatedFaceModel(
        control - center,
        faces,
        parametrize_disc(lifted, faces, mirror=mirror),
        _region_of_faces(lifted, slit, lifted_curves, {r.name: r.index for r in regions.values()}),
        regions,
        landmark_points=_landmark_points(
            control, faces, slit.film, half_landmarks(lifted_curves, half.middle, half.skin)
        ),
        name="default annotated face model",
    )


def _control_vertices(layout: FaceLayout, flat: FloatArray, faces: IntArray) -> FloatArray:
    """Solve for control vertices P whose limit surface S P is closest to the lifted layout.

    The plane's own control mesh Q has the layout as its limit, ``L Q = flat``; then ``S P = lift(S Q)`` in
    the least-squares sense over the vertices of two refinements, so lines between vertices count too.
    """
    plane = splu(limit_matrix(len(flat), faces).tocsc()).solve(flat)
    refined = LoopSubdivision.of(len(flat), faces, FIT_LEVELS).matrix
    target = layout.lift(refined @ plane)
    return splu((refined.T @ refined).tocsc()).solve(refined.T @ target)


def _symmetric(points: FloatArray, mirror: IntArray) -> FloatArray:
    return 0.5 * (points + points[mirror] * [-1, 1, 1])


def _centroid(control: FloatArray, faces: IntArray) -> FloatArray:
    """Return the area centroid of the limit surface, x exactly 0."""
    subdivision = LoopSubdivision.of(len(control), faces, 2)
    surface = subdivision.matrix @ control
    center = np.average(
        surface[subdivision.faces].mean(1), axis=0, weights=face_areas(surface, subdivision.faces)
    )
    return center * [0, 1, 1]


def _region_of_faces(
    lifted: FloatArray, slit: SlitMesh, curves: dict[str, FloatArray], index: dict[str, int]
) -> NDArray[np.uint8]:
    faces = slit.mesh.faces
    neighbours = _face_neighbours(faces)
    names = half_region_names(lifted[faces].mean(1), curves)
    names = [MOUTH_REGION if film else name for name, film in zip(names, slit.film, strict=True)]
    names = in_one_piece(without_spikes(names, neighbours), neighbours)
    sided = [
        [index[n if n in MIDDLE_REGIONS else f"{side}_{n}"] for n in names] for side in ("left", "right")
    ]
    return np.array(sided[0] + sided[1], np.uint8)


def _face_neighbours(faces: IntArray) -> list[list[int]]:
    """Return, per face, the faces across its edges."""
    across: dict[tuple[int, int], list[int]] = {}
    for face, corners in enumerate(faces.tolist()):
        for a, b in ((0, 1), (1, 2), (2, 0)):
            edge = (min(corners[a], corners[b]), max(corners[a], corners[b]))
            across.setdefault(edge, []).append(face)
    neighbours: list[list[int]] = [[] for _ in faces]
    for first, *second in across.values():
        for other in second:
            neighbours[first].append(other)
            neighbours[other].append(first)
    return neighbours


def _landmark_points(
    control: FloatArray, faces: IntArray, film: BoolArray, targets: dict[int, FloatArray]
) -> SurfacePoints:
    """Return the 68 landmarks: closest points of the limit surface but its film, the right half mirrored."""
    numbers = sorted(targets)
    subdivision = LoopSubdivision.of(len(control), faces, LANDMARK_LEVELS)
    left = np.arange(len(subdivision.faces)) < len(subdivision.faces) // 2
    skin = np.flatnonzero(left & ~np.tile(film, 2)[subdivision.parent])
    hits = ClosestPointQuery(subdivision.matrix @ control, subdivision.faces[skin]).query(
        np.stack([targets[n] for n in numbers])
    )
    found = subdivision.control_points(SurfacePoints(skin[hits.face], hits.barycentric))
    face, weights = np.zeros(68, np.int64), np.zeros((68, 3))
    face[numbers], weights[numbers] = found.face, found.barycentric
    for middle in MIDDLE:
        weights[middle] = _on_midline(weights[middle], np.abs(control[faces[face[middle]], 0]) < 1e-9)
    for left_number, right_number in LEFT_TO_RIGHT:
        # The mirror image of face f is f + F / 2 with its last two corners swapped.
        face[right_number] = face[left_number] + len(faces) // 2
        weights[right_number] = weights[left_number][[0, 2, 1]]
    return SurfacePoints(face, weights)


def _on_midline(weights: FloatArray, corner_on_midline: BoolArray) -> FloatArray:
    kept = np.where(corner_on_midline, weights, 0.0)
    return kept / kept.sum()
