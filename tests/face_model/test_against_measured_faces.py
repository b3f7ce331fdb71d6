"""The default model beside faces that others measured; they are data to judge it by, not its source."""

import igl
import numpy as np
import pytest

from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.rasterization import interpolate, rasterize
from scan2albedo.geometry.rigid import procrustes, transform_points

INNER = slice(17, 68)


@pytest.fixture
def ict_face(shared_data):
    """Return a function: the vertices, inner faces and landmarks of a measured face by name."""
    data = np.load(shared_data / "ict_faces.npz")

    def named(name):
        vertices, faces = data[f"shape_{name}"].astype(float), data["faces"].astype(np.int64)
        inner = faces[(faces < int(data["narrow_face_vertices"])).all(1)]
        return vertices, inner, vertices[data["landmarks68"]]

    return named


def compare(model, vertices, faces, landmarks=None):
    """Align the model to a face by rigid ICP with scale.

    Return the mean distance of the face's vertices to the model, and of 51 landmarks, in millimetres.
    """
    surface, model_faces = model.surface(2)
    if landmarks is None:
        pose = np.eye(4)
        pose[:3, 3] = vertices.mean(0) - surface.mean(0)
    else:
        pose = procrustes(model.landmarks[INNER], landmarks[INNER], scale=True)
    query = ClosestPointQuery(vertices, faces)
    sampled = surface[::7]
    for _ in range(30):
        hits = query.query(transform_points(pose, sampled))
        near = hits.distance < 10
        pose = procrustes(sampled[near], hits.points[near], scale=True)
    placed = ClosestPointQuery(transform_points(pose, surface), model_faces)
    distance = placed.query(vertices[np.unique(faces)]).distance.mean()
    if landmarks is None:
        return distance, np.nan
    return distance, np.linalg.norm(transform_points(pose, model.landmarks) - landmarks, axis=1)[INNER].mean()


@pytest.mark.parametrize(
    ("name", "surface", "landmarks"),
    [("generic_neutral", 3.0, 2.5), *((f"person{number}", 4.2, 5.0) for number in (1, 2, 3, 4))],
)
def test_measured_faces_are_near(ict_face, model, name, surface, landmarks):
    distance, error = compare(model, *ict_face(name))
    assert distance <= surface
    assert error <= landmarks


def test_the_canonical_face(shared_data, model):
    vertices, _, _, faces, _, _ = igl.readOBJ(str(shared_data / "canonical_face_model.obj"))
    assert compare(model, 10 * vertices, faces)[0] <= 2.5


def profile(vertices, faces, heights):
    """Return the depth of the midline at heights, NaN where nothing is there."""
    column = np.stack([vertices[:, 0] + 1.5, -vertices[:, 1]], 1)
    low = column[:, 1].min()
    raster = rasterize(column - [0, low], vertices[:, 2], faces, (int(np.ptp(column[:, 1])) + 2, 4))
    depth = interpolate(raster, faces, vertices[:, 2:])[:, 1, 0]
    depth[~raster.covered[:, 1]] = np.nan
    return np.interp(heights, -(np.arange(len(depth)) + low)[::-1], depth[::-1])


def test_depth_profile_of_the_midline(ict_face, model):
    vertices, faces, landmarks = ict_face("generic_neutral")
    pose = procrustes(model.landmarks[INNER], landmarks[INNER], scale=True)
    surface, model_faces = model.surface(3)
    heights = np.arange(landmarks[8, 1] + 6, landmarks[27, 1] + 45, 2.0)
    placed = profile(transform_points(pose, surface), model_faces, heights)
    difference = placed - profile(vertices, faces, heights)
    difference = difference[np.isfinite(difference)]
    assert len(difference) > 0.9 * len(heights)
    assert np.mean(np.abs(difference)) < 2.5
