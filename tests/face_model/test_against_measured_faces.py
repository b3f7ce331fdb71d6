"""The default model beside faces that others measured; they are data to judge it by, not its source."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from scan2albedo import AnnotatedFaceModel
from scan2albedo.geometry.closest_points import ClosestPointQuery

DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data"
INNER = slice(17, 68)


@dataclass(frozen=True)
class MeasuredFace:
    vertices: np.ndarray
    faces: np.ndarray
    landmarks: np.ndarray | None = None


def ict_face(name):
    path = DATA / "ict_faces.npz"
    if not path.exists():
        pytest.skip(f"{path} is not there")
    with np.load(path) as data:
        vertices = data[f"shape_{name}"].astype(float)
        faces, narrow = data["faces"].astype(np.int64), int(data["narrow_face_vertices"])
        return MeasuredFace(vertices, faces[(faces < narrow).all(1)], vertices[data["landmarks68"]])


def canonical_face():
    path = DATA / "canonical_face_model.obj"
    if not path.exists():
        pytest.skip(f"{path} is not there")
    rows = [line.split() for line in path.read_text().splitlines()]
    vertices = 10 * np.array([row[1:4] for row in rows if row and row[0] == "v"], float)
    faces = [[int(c.split("/")[0]) - 1 for c in row[1:4]] for row in rows if row and row[0] == "f"]
    return MeasuredFace(vertices, np.array(faces))


def similarity(source, target):
    """Return (scale, rotation, shift) with target ~ scale R source + shift (Umeyama 1991)."""
    a, b = source - source.mean(0), target - target.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    flip = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ flip @ vt
    scale = np.trace(np.diag(s) @ flip) / np.sum(a**2)
    return scale, rotation, target.mean(0) - scale * rotation @ source.mean(0)


@dataclass(frozen=True)
class Comparison:
    """Millimetres: mean distance of the face's vertices to the model and of 51 landmarks."""

    surface: float
    landmarks: float


def compare(face, turns=30):
    """Align the model to a face by rigid ICP with scale, then measure."""
    model = AnnotatedFaceModel.default()
    surface, faces = model.surface(2)
    if face.landmarks is not None:
        pose = similarity(model.landmarks[INNER], face.landmarks[INNER])
    else:
        pose = 1.0, np.eye(3), face.vertices.mean(0) - surface.mean(0)
    query = ClosestPointQuery(face.vertices, face.faces)
    sampled = surface[::7]
    for _ in range(turns):
        scale, rotation, shift = pose
        hits = query.query(scale * sampled @ rotation.T + shift)
        near = hits.distance < 10
        pose = similarity(sampled[near], hits.points[near])
    scale, rotation, shift = pose
    used = face.vertices[np.unique(face.faces)]
    back = ClosestPointQuery(surface, faces).query((used - shift) @ rotation / scale)
    error = np.nan
    if face.landmarks is not None:
        placed = scale * model.landmarks @ rotation.T + shift
        error = float(np.linalg.norm(placed - face.landmarks, axis=1)[INNER].mean())
    return Comparison(float(scale * back.distance.mean()), error)


def test_the_generic_face():
    result = compare(ict_face("generic_neutral"))
    assert result.surface <= 3.0
    assert result.landmarks <= 2.5


@pytest.mark.parametrize("person", ["person1", "person2", "person3", "person4"])
def test_persons(person):
    result = compare(ict_face(person))
    assert result.surface <= 4.2
    assert result.landmarks <= 5.0


def test_the_canonical_face():
    assert compare(canonical_face()).surface <= 2.5


def profile(vertices, faces, heights):
    """Return the depth of the midline at heights, NaN where nothing is there."""
    from scan2albedo.geometry.rasterization import interpolate, rasterize

    column = np.stack([vertices[:, 0] + 1.5, -vertices[:, 1]], 1)
    low = column[:, 1].min()
    raster = rasterize(column - [0, low], vertices[:, 2], faces, (int(np.ptp(column[:, 1])) + 2, 4))
    depth = interpolate(raster, faces, vertices[:, 2:])[:, 1, 0]
    depth[~raster.covered[:, 1]] = np.nan
    return np.interp(heights, -(np.arange(len(depth)) + low)[::-1], depth[::-1])


def test_depth_profile_of_the_midline():
    face, model = ict_face("generic_neutral"), AnnotatedFaceModel.default()
    scale, rotation, shift = similarity(model.landmarks[INNER], face.landmarks[INNER])
    surface, faces = model.surface(3)
    placed = scale * surface @ rotation.T + shift
    top, bottom = face.landmarks[27, 1] + 45, face.landmarks[8, 1] + 6
    heights = np.arange(bottom, top, 2.0)
    difference = profile(placed, faces, heights) - profile(face.vertices, face.faces, heights)
    difference = difference[np.isfinite(difference)]
    assert len(difference) > 0.9 * len(heights)
    assert np.mean(np.abs(difference)) < 2.5
