"""The voxel grid over a prepared scan against brute force."""

import numpy as np

from scan2albedo.geometry.oriented_points import OrientedPoints
from scan2albedo.geometry.alignment import NearestGrid


def test_cells_hold_nearly_the_nearest_sample(bumpy):
    grid = NearestGrid.of(bumpy, cell=5.0, margin=30.0)
    rng = np.random.default_rng(0)
    probes = rng.uniform(bumpy.points.min(0) - 25, bumpy.points.max(0) + 25, (2000, 3))
    exact = np.linalg.norm(probes[:, None] - bumpy.points[None], axis=2).min(1)
    looked_up = np.linalg.norm(bumpy.points[grid.nearest_samples(probes)] - probes, axis=1)
    # Half a cell's diagonal is what looking up instead of searching may cost.
    assert (looked_up - exact).max() < 5.0 * np.sqrt(3)
    assert (looked_up - exact).mean() < 1.0


def test_outside_the_grid_there_is_nothing(bumpy):
    grid = NearestGrid.of(bumpy, cell=5.0, margin=10.0)
    assert grid.nearest_samples(np.array([[1e4, 0, 0], [0, -1e4, 0]])).tolist() == [-1, -1]


def test_a_huge_box_gets_larger_cells_not_more_memory():
    far = OrientedPoints(np.array([[0.0, 0, 0], [1e5, 1e5, 1e5]]), np.eye(3)[:2], np.ones(2))
    grid = NearestGrid.of(far, cell=5.0, margin=40.0)
    assert grid.nearest.size < 2_000_000
    assert grid.nearest_samples(far.points).tolist() == [0, 1]
