"""Depth images against rays and closed forms; what counts as a face: not balls, boxes and wrong poses."""

import numpy as np
import pytest
from helpers.meshes import grid, sphere
from helpers.poses import REST
from numpy.testing import assert_allclose

from scan2albedo.geometry.mesh import vertex_normals
from scan2albedo.geometry.oriented_points import SurfaceNoise
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.geometry.rigid import (
    compose,
    random_rotation,
    rotation_from_vector,
    transform_points,
)
from scan2albedo.registration.candidates import Candidate
from scan2albedo.registration.relief import DepthFrame, FaceImage, depth_image, without_quadratic_trend


def pixel_centres(frame):
    """Return (size, size, 2) x and y: row 0 is the top, column 0 the left."""
    offset = (np.arange(frame.size) - (frame.size - 1) / 2) * frame.width / frame.size
    x, y = np.meshgrid(frame.center[0] + offset, frame.center[1] - offset)
    return np.stack([x, y], -1)


@pytest.mark.parametrize("size", [1, 31, 64])
def test_depth_equals_the_first_hit_of_a_ray_from_the_viewer(model, size):
    vertices, faces = model.surface(1)
    frame = DepthFrame((5.0, -3.0), 190.0, size)
    pose = compose(random_rotation(np.random.default_rng(1)), [3.0, 4.0, -20.0])
    image = depth_image(vertices, faces, frame, pose)
    xy = pixel_centres(frame).reshape(-1, 2)
    origins = np.column_stack([xy, np.full(len(xy), 500.0)])
    hits = RayCaster(transform_points(pose, vertices), faces).first_hit(origins, [0, 0, -1.0])
    expected = (500 - hits.distance).reshape(size, size)
    both = np.isfinite(image) & np.isfinite(expected)
    # A ray through a silhouette edge may go either way.
    assert (np.isfinite(image) != np.isfinite(expected)).mean() < 0.002
    assert_allclose(image[both], expected[both], atol=2e-3)


def test_empty_pixels_are_minus_infinity_and_the_limit_looks_through():
    vertices = np.array([[-1.0, -1, 0], [1, -1, 0], [0, 2, 0], [-9, -9, 5], [9, -9, 5], [0, 20, 5]])
    faces = np.arange(6).reshape(2, 3)
    frame = DepthFrame((0.0, 0.0), 60.0, 61)
    assert depth_image(vertices, faces, frame)[30, 30] == 5
    assert depth_image(vertices, faces, frame, z_limit=4.0)[30, 30] == 0
    assert depth_image(vertices, faces, frame)[0, 0] == -np.inf


@pytest.mark.parametrize("jitter", [0.0, 1e-14, 0.3])
def test_neighbouring_faces_leave_no_pixel_between_them(jitter):
    # Without jitter every pixel centre lies on edges or corners of the grid; 1e-14 makes rows near level.
    flat, faces = grid(9, 9)
    xy = 8 * flat[:, :2] - 4 + jitter * np.random.default_rng(0).uniform(-1, 1, (81, 2))
    vertices = np.column_stack([xy, xy @ [0.5, -0.25]])
    frame = DepthFrame((0.0, 0.0), 7.0, 7)
    image = depth_image(vertices, faces, frame)
    assert_allclose(image, pixel_centres(frame) @ [0.5, -0.25], atol=1e-9)
    assert_allclose(depth_image(vertices, faces[:, ::-1], frame), image, atol=1e-9)


@pytest.fixture(scope="module")
def image(model):
    return FaceImage(*model.surface(1))


def test_depth_along_the_view_matters_only_when_it_is_far(image, model):
    near, far = (image.agreement(*model.surface(1), compose(np.eye(3), [0, 0, z])) for z in (5.0, 300.0))
    assert near.local > 0.9
    assert (far.coverage, far.local, far.whole) == (0, 0, 0)


@pytest.mark.parametrize(
    "turn", [[0, 0, np.pi], [0, 0, np.pi / 2], [0, 0, np.radians(40)], [0, np.radians(50), 0]]
)
def test_a_wrongly_turned_model_is_no_face(image, model, turn):
    pose = compose(rotation_from_vector(turn), np.zeros(3))
    assert Candidate(REST, image.agreement(*model.surface(1), pose), 0.0).ranking < 0.5


def test_half_a_face_scores_nearly_as_a_whole_one(image, model):
    vertices, faces = model.surface(1)
    half = faces[(vertices[faces][..., 0] > 0).all(1)]
    scores = image.agreement(vertices, half, np.eye(4))
    assert 0.4 < scores.coverage < 0.6
    assert Candidate(REST, scores, 0.0).ranking > 0.7


def test_trend_removal_leaves_nothing_of_a_quadratic():
    rng = np.random.default_rng(0)
    at = rng.uniform(-0.5, 0.5, (200, 2))
    x, y = at.T
    weights = rng.uniform(0.1, 1, 200)
    quadratic = 3 - x + 2 * y + 4 * x * x - x * y + 0.5 * y * y
    assert np.abs(without_quadratic_trend(quadratic, at, weights)).max() < 1e-6
    wave = np.sin(40 * x)
    rest = without_quadratic_trend(quadratic + wave, at, weights)
    assert weights @ (rest * wave) > 0.97 * np.sqrt((weights @ rest**2) * (weights @ wave**2))


def test_the_model_agrees_with_itself_and_its_back_does_not(image, model):
    vertices, faces = model.surface(2)
    noise = SurfaceNoise.of(vertices, faces)
    same = image.agreement(vertices, faces, np.eye(4), noise=noise)
    assert same.whole > 0.99
    assert same.local > 0.9
    assert same.coverage > 0.98
    other = image.agreement(vertices * [1, -1, 1], faces, np.eye(4), noise=noise)
    assert other.whole < 0.6
    assert other.local < 0.6


@pytest.mark.parametrize("noise_mm", [0.5, 1.0, 2.0, 4.0])
def test_what_noise_takes_from_the_agreement_is_given_back(image, model, noise_mm):
    vertices, faces = model.surface(1)
    clean = image.agreement(vertices, faces, np.eye(4), noise=SurfaceNoise.of(vertices, faces))
    rng = np.random.default_rng(4)
    noisy = vertices + rng.normal(scale=noise_mm, size=(len(vertices), 1)) * vertex_normals(vertices, faces)
    found = image.agreement(noisy, faces, np.eye(4), noise=SurfaceNoise.of(noisy, faces))
    assert found.whole < clean.whole
    assert found.without_noise() > 0.99


def test_noise_excuses_no_other_shape(image, model):
    points, faces = sphere(5, 95.0)
    points = points * (1 + np.random.default_rng(2).normal(scale=3 / 95, size=(len(points), 1)))
    points = points + [0, 0, model.surface(1)[0][:, 2].max() - 105]
    found = image.agreement(points, faces, np.eye(4), noise=SurfaceNoise.of(points, faces))
    assert found.noise_mm > 1.5
    assert found.without_noise() < 0.5
