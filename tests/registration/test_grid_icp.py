"""The voxel grid against brute force, and the compiled ICP against a known answer."""

import numpy as np
import pytest
import trimesh

from scan2albedo.geometry.oriented_points import OrientedPoints, oriented_points
from scan2albedo.geometry.rigid import compose, random_rotation, rotation_angle_rad, rotation_from_vector
from scan2albedo.registration.grid_icp import (
    NearestGrid,
    _accumulate,
    _accumulate_point,
    _solve6,
    refine_on_grid,
)


@pytest.fixture(scope="module")
def bumpy() -> OrientedPoints:
    """An asymmetric closed shape, so that its pose is unique."""
    mesh = trimesh.creation.icosphere(5, 1.0)
    unit = np.asarray(mesh.vertices)
    axes = np.array([[0, 0, 1.0], [0.6, 0.8, 0], [-0.8, 0, 0.6]])
    radius = 70 * (1 + np.exp(6 * (unit @ axes.T - 1)) @ [0.35, 0.25, 0.2])
    return oriented_points(unit * radius[:, None], np.asarray(mesh.faces), 4.0)


def test_cells_hold_nearly_the_nearest_sample(bumpy):
    grid = NearestGrid.of(bumpy, cell_mm=5.0, margin_mm=30.0)
    rng = np.random.default_rng(0)
    probes = rng.uniform(bumpy.points.min(0) - 25, bumpy.points.max(0) + 25, (2000, 3))
    exact = np.linalg.norm(probes[:, None] - bumpy.points[None], axis=2).min(1)
    looked_up = np.linalg.norm(bumpy.points[grid.nearest_samples(probes)] - probes, axis=1)
    # Half a cell's diagonal is what looking up instead of searching may cost.
    assert (looked_up - exact).max() < 5.0 * np.sqrt(3)
    assert (looked_up - exact).mean() < 1.0


def test_outside_the_grid_there_is_nothing(bumpy):
    grid = NearestGrid.of(bumpy, cell_mm=5.0, margin_mm=10.0)
    assert grid.nearest_samples(np.array([[1e4, 0, 0], [0, -1e4, 0]])).tolist() == [-1, -1]


def test_a_huge_box_gets_larger_cells_not_more_memory():
    far = OrientedPoints(np.array([[0.0, 0, 0], [1e5, 1e5, 1e5]]), np.eye(3)[:2], np.ones(2))
    grid = NearestGrid.of(far, cell_mm=5.0, margin_mm=40.0)
    assert grid.nearest.size < 2_000_000
    assert grid.nearest_samples(far.points).tolist() == [0, 1]


def test_icp_walks_back_from_twenty_degrees(bumpy):
    rng = np.random.default_rng(1)
    truth = compose(random_rotation(rng), [10.0, -20.0, 5.0])
    scan = OrientedPoints(
        bumpy.points @ truth[:3, :3].T + truth[:3, 3], bumpy.normals @ truth[:3, :3].T, bumpy.areas
    )
    grid = NearestGrid.of(scan, cell_mm=4.0, margin_mm=40.0)
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
    grid = NearestGrid.of(bumpy, cell_mm=5.0, margin_mm=20.0)
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
