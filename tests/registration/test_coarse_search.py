"""Starting poses face outward and reach every part of a scan; the compiled ICP finds a known answer."""

import numpy as np
import trimesh

from scan2albedo.geometry.oriented_points import OrientedPoints, anchors, oriented_points
from scan2albedo.geometry.rigid import compose, random_rotation, rotation_angle_rad, rotation_from_vector
from scan2albedo.registration.coarse_search import (
    _accumulate,
    _accumulate_point,
    _solve6,
    anchored_starts,
    refine_on_grid,
)
from scan2albedo.geometry.alignment import NearestGrid


def test_starts_on_a_sphere_face_outward_everywhere():
    mesh = trimesh.creation.icosphere(4, 90.0)
    samples = oriented_points(np.asarray(mesh.vertices), np.asarray(mesh.faces), 5.0)
    spread = anchors(samples, spacing=30.0, limit=600, reach=45.0)
    front = np.array([1.0, 2.0, 40.0])
    starts = anchored_starts(spread, front, 300)
    on_surface = np.einsum("nij,j->ni", starts.rotations, front) + starts.translations
    outward = on_surface / np.linalg.norm(on_surface, axis=1, keepdims=True)
    cosine = np.einsum("ni,ni->n", outward, starts.rotations[:, :, 2])
    assert np.degrees(np.arccos(cosine.min())) < 36.5
    directions = np.random.default_rng(0).normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    assert np.degrees(np.arccos((directions @ outward.T).max(1).min())) < 25
    # Every anchor is tried at several roll angles.
    assert len(starts) > 10 * len(np.unique(on_surface.round(3), axis=0))


def test_icp_walks_back_from_twenty_degrees(bumpy):
    rng = np.random.default_rng(1)
    truth = compose(random_rotation(rng), [10.0, -20.0, 5.0])
    scan = OrientedPoints(
        bumpy.points @ truth[:3, :3].T + truth[:3, 3], bumpy.normals @ truth[:3, :3].T, bumpy.areas
    )
    grid = NearestGrid.of(scan, cell=4.0, margin=40.0)
    axes = rng.normal(size=(10, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    rotations = np.array([rotation_from_vector(np.radians(20) * axis) @ truth[:3, :3] for axis in axes])
    translations = truth[:3, 3] + 8 * axes
    scores = refine_on_grid(
        grid, bumpy, bumpy.areas, rotations, translations, iterations=25, sigma_mm=(20.0, 3.0)
    )
    errors = np.degrees([rotation_angle_rad(r @ truth[:3, :3].T) for r in rotations])
    assert errors.max() < 4
    assert np.median(errors) < 2
    assert np.linalg.norm(translations - truth[:3, 3], axis=1).max() < 2
    assert scores.min() > 0.4
    np.testing.assert_allclose(np.linalg.det(rotations), 1)


def test_a_model_far_from_everything_scores_zero_and_stays_finite(bumpy):
    grid = NearestGrid.of(bumpy, cell=5.0, margin=20.0)
    rotations, translations = np.eye(3)[None].copy(), np.array([[5000.0, 0, 0]])
    scores = refine_on_grid(
        grid, bumpy, bumpy.areas, rotations, translations, iterations=5, sigma_mm=(10.0, 5.0)
    )
    assert scores.tolist() == [0.0]
    assert translations.tolist() == [[5000.0, 0, 0]]


def test_closed_sums_equal_the_rows_written_out():
    rng = np.random.default_rng(0)
    matrix, gradient, row = np.zeros((6, 6)), np.zeros(6), np.zeros(6)
    expected, right = np.zeros((6, 6)), np.zeros(6)
    for _ in range(5):
        x, error, normal = rng.normal(size=(3, 3))
        _accumulate(matrix, gradient, row, 0.7, *normal, *x, *error)
        _accumulate_point(matrix, gradient, 0.1, *x, *error)
        for weight, axis in [(0.7, normal), *((0.1, unit) for unit in np.eye(3))]:
            jacobian = np.r_[np.cross(x, axis), axis]
            expected += weight * np.outer(jacobian, jacobian)
            right -= weight * jacobian * (axis @ error)
    np.testing.assert_allclose(np.tril(matrix), np.tril(expected), atol=1e-12)
    np.testing.assert_allclose(gradient, right, atol=1e-12)
    step = np.zeros(6)
    assert _solve6(matrix.copy(), gradient, step)
    np.testing.assert_allclose(expected @ step, right, atol=1e-9)


def test_a_singular_system_is_reported():
    assert not _solve6(np.zeros((6, 6)), np.zeros(6), np.zeros(6))
