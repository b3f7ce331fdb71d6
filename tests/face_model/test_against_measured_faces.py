"""The default model beside faces that others measured; they are data to judge it by, not its source."""

import numpy as np
import pytest
from helpers.measures import row_lengths

from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.rigid import procrustes, transform_points


@pytest.mark.parametrize(
    ("name", "surface_mm", "landmarks_mm"),
    [("generic_neutral", 3.0, 2.5), *((f"person{number}", 4.2, 5.0) for number in (1, 2, 3, 4))],
)
def test_measured_faces_are_near(shared_data, model, name, surface_mm, landmarks_mm):
    """After rigid ICP with scale: mean distances of the face's vertices, and of 51 landmarks."""
    data = np.load(shared_data / "ict_faces.npz")
    vertices, faces = data[f"shape_{name}"].astype(float), data["faces"].astype(np.int64)
    faces = faces[(faces < int(data["narrow_face_vertices"])).all(1)]
    inner, expected = model.landmarks[17:], vertices[data["landmarks68"][17:]]
    surface, model_faces = model.surface(2)
    pose, query = procrustes(inner, expected, scale=True), ClosestPointQuery(vertices, faces)
    for _ in range(30):
        hits = query.query(transform_points(pose, surface[::7]))
        near = hits.distance < 10
        pose = procrustes(surface[::7][near], hits.points[near], scale=True)
    placed = ClosestPointQuery(transform_points(pose, surface), model_faces)
    assert placed.query(vertices[np.unique(faces)]).distance.mean() <= surface_mm
    assert row_lengths(transform_points(pose, inner) - expected).mean() <= landmarks_mm
