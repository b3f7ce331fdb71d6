"""What counts as a face: its own model does, balls, boxes and wrong poses do not."""

import numpy as np
import pytest
import trimesh

from scan2albedo.geometry.rigid import compose, rotation_from_vector
from scan2albedo.registration.scoring import FaceImage, correlation, without_quadratic_trend


@pytest.fixture(scope="module")
def image(model) -> FaceImage:
    return FaceImage(*model.surface(1))


def test_the_model_is_its_own_perfect_face(image, model):
    scores = image.scores(*model.surface(2), np.eye(4))
    assert scores.relief_correlation > 0.9
    assert scores.coverage > 0.98


def test_depth_along_the_view_does_not_matter(image, model):
    vertices, faces = model.surface(1)
    near = image.scores(vertices, faces, compose(np.eye(3), [0, 0, 5.0]))
    assert near.relief_correlation > 0.9


@pytest.mark.parametrize(
    "turn", [[0, 0, np.pi], [0, 0, np.pi / 2], [0, 0, np.radians(40)], [0, np.radians(50), 0]]
)
def test_a_wrongly_turned_model_is_no_face(image, model, turn):
    vertices, faces = model.surface(1)
    pose = compose(rotation_from_vector(turn), np.zeros(3))
    assert image.scores(vertices, faces, pose).ranking < 0.5


def test_smooth_bodies_have_no_relief(image, model):
    front = model.surface(0)[0][:, 2].max()
    for mesh in (trimesh.creation.icosphere(5, 90.0), trimesh.creation.cylinder(70, 300, sections=90)):
        body = np.asarray(mesh.vertices)
        pose = compose(np.eye(3), [0, 0, front - body[:, 2].max()])
        assert image.scores(body, np.asarray(mesh.faces), pose).relief_correlation < 0.4


def test_far_away_there_is_neither_coverage_nor_relief(image, model):
    scores = image.scores(*model.surface(1), compose(np.eye(3), [0, 0, 300.0]))
    assert (scores.coverage, scores.relief_correlation, scores.ranking) == (0, 0, 0)


def test_half_a_face_scores_nearly_as_a_whole_one(image, model):
    vertices, faces = model.surface(1)
    half = faces[(vertices[faces][..., 0] > 0).all(1)]
    scores = image.scores(vertices, half, np.eye(4))
    assert 0.4 < scores.coverage < 0.6
    assert scores.ranking > 0.7


def test_trend_removal_leaves_nothing_of_a_quadratic():
    rng = np.random.default_rng(0)
    at = rng.uniform(-0.5, 0.5, (200, 2))
    x, y = at.T
    weights = rng.uniform(0.1, 1, 200)
    quadratic = 3 - x + 2 * y + 4 * x * x - x * y + 0.5 * y * y
    assert np.abs(without_quadratic_trend(quadratic, at, weights)).max() < 1e-6
    wave = np.sin(40 * x)
    rest = without_quadratic_trend(quadratic + wave, at, weights)
    assert correlation(rest, wave, weights) > 0.97


def test_correlation_of_nothing_is_zero():
    assert correlation(np.zeros(3), np.ones(3), np.ones(3)) == 0


def test_the_model_is_symmetric_and_its_symmetry_raises_the_certainty(image, model):
    scores = image.scores(*model.surface(2), np.eye(4))
    assert scores.symmetry > 0.85
    assert scores.certainty > scores.likeness + 0.1


def test_an_expression_of_one_side_lessens_symmetry_and_half_a_face_loses_no_certainty(image, model):
    vertices, faces = model.surface(2)
    crooked = vertices.copy()
    right = vertices[:, 0] < 0
    crooked[right, 2] += 6 * np.sin(vertices[right, 1] / 6) * np.clip(-vertices[right, 0] / 20, 0, 1)
    assert image.scores(crooked, faces, np.eye(4)).symmetry < 0.75
    half = image.scores(vertices, faces[(vertices[faces][..., 0] > 0).all(1)], np.eye(4))
    assert half.certainty >= half.likeness
