"""The alignment finds known poses, sizes and shapes; the compiled one takes the same steps."""

import numpy as np
import pytest
from helpers.meshes import bumpy_samples
from helpers.poses import REST
from numpy.testing import assert_allclose

from scan2albedo.geometry.alignment import Alignment, NearestGrid, Pairs, align, align_on_grid
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.oriented_points import OrientedPoints
from scan2albedo.geometry.rigid import (
    Similarity,
    random_rotation,
    rotation_angle_rad,
    rotation_from_vector,
)


@pytest.fixture(scope="module")
def bumpy():
    return bumpy_samples()


def aligned(samples, pairs, start=REST, **options):
    return align(samples.points, samples.areas, pairs, start, **options)


def to(targets, normals, **more):
    """Pairs with known targets."""
    return lambda now, points: Pairs(targets - points, normals, np.ones(len(points)), **more)


def test_known_pairs_give_pose_and_size(bumpy):
    truth = Similarity(rotation_from_vector([0.2, -0.1, 0.15]), np.array([3.0, -9.0, 4.0]), 1.1)
    targets, normals = truth.apply(bumpy.points), bumpy.normals @ truth.rotation.T
    found = aligned(bumpy, to(targets, normals), steps=20, settled=1e-6)
    assert found.converged
    assert found.steps < 20
    assert_allclose(found.pose.matrix(), truth.matrix(), atol=1e-6)
    kept = aligned(bumpy, to(targets, normals), steps=20, scale_range=(1.0, 1.05))
    assert kept.pose.scale == pytest.approx(1.05)


def test_modes_are_found_and_held_by_their_prior(bumpy):
    modes = np.random.default_rng(0).normal(size=(len(bumpy), 3, 4))
    drawn = np.array([1.0, -2.0, 0.5, 0.0])
    pairs = to(bumpy.points + modes @ drawn, bumpy.normals, noise=1.0)
    free = aligned(bumpy, pairs, steps=6, modes=modes)
    assert_allclose(free.coefficients, drawn, atol=1e-6)
    start = Alignment(REST, drawn)
    assert aligned(bumpy, pairs, start, steps=1, modes=modes).moved < 1e-6
    held = aligned(bumpy, pairs, steps=6, modes=modes, precision=1e3 * np.eye(5))
    assert np.abs(held.coefficients).max() < 0.5


def looked_up(grid, points):
    """The sample of the cell that each point lies in."""
    return grid.nearest[tuple(np.floor((points - grid.origin) / grid.cell).astype(int).T)]


def test_points_slide_along_their_planes_unless_held(bumpy):
    shifted = bumpy.points + [2.0, 0, 0]
    flat = np.tile([0, 0, 1.0], (len(bumpy), 1))
    free = aligned(bumpy, to(shifted, flat), steps=3)
    assert np.abs(free.pose.translation[0]) < 1e-6
    held = aligned(bumpy, to(shifted, flat, along=0.1), steps=3)
    assert_allclose(held.pose.translation, [2, 0, 0], atol=1e-6)


def test_without_pairs_it_stays(bumpy):
    found = aligned(bumpy, lambda now, points: None, steps=3)
    assert (found.steps, found.converged) == (0, False)
    assert found.pose is REST


def test_the_compiled_step_is_that_of_align(bumpy):
    sigma = 10.0
    grid = NearestGrid.of(bumpy, cell=4.0, margin=40.0)
    start = Similarity(rotation_from_vector([0.1, -0.05, 0.08]), np.array([3.0, 2.0, -1.0]))

    def pairs(now, points):
        nearest = looked_up(grid, points)
        offset, normals = bumpy.points[nearest] - points, bumpy.normals @ now.pose.rotation.T
        agreement = np.maximum(np.einsum("ij,ij->i", normals, bumpy.normals[nearest]), 0)
        trust = agreement**2 * (sigma**2 / (sigma**2 + np.sum(offset**2, axis=1))) ** 2
        # A tenth beside the whole.
        return Pairs(offset, normalized(normals + bumpy.normals[nearest]), 1.1 * trust, 0.1 / 1.1)

    expected = aligned(bumpy, pairs, start, steps=1, scale_range=(1.0, 1.0)).pose
    rotations, translations = start.rotation[None].copy(), start.translation[None].copy()
    align_on_grid(grid, bumpy, rotations, translations, steps=1, sigma=(sigma, sigma))
    assert_allclose(rotations[0], expected.rotation, atol=1e-7)
    assert_allclose(translations[0], expected.translation, atol=1e-5)


def test_icp_walks_back_from_twenty_degrees(bumpy):
    rng = np.random.default_rng(1)
    rotation, shift = random_rotation(rng), np.array([10.0, -20.0, 5.0])
    scan = OrientedPoints(bumpy.points @ rotation.T + shift, bumpy.normals @ rotation.T, bumpy.areas)
    grid = NearestGrid.of(scan, cell=4.0, margin=40.0)
    axes = normalized(rng.normal(size=(10, 3)))
    rotations = np.array([rotation_from_vector(np.radians(20) * axis) @ rotation for axis in axes])
    translations = shift + 8 * axes
    scores = align_on_grid(grid, bumpy, rotations, translations, steps=25, sigma=(20.0, 3.0))
    errors = np.degrees([rotation_angle_rad(r @ rotation.T) for r in rotations])
    assert errors.max() < 4
    assert np.median(errors) < 2
    assert np.linalg.norm(translations - shift, axis=1).max() < 2
    assert scores.min() > 0.4
    assert_allclose(np.linalg.det(rotations), 1)


def test_a_model_far_from_everything_scores_zero_and_stays_finite(bumpy):
    grid = NearestGrid.of(bumpy, cell=5.0, margin=20.0)
    rotations, translations = np.eye(3)[None].copy(), np.array([[5000.0, 0, 0]])
    scores = align_on_grid(grid, bumpy, rotations, translations, steps=5, sigma=(10.0, 5.0))
    assert (scores, *translations[0]) == (0, 5000, 0, 0)


def test_cells_hold_nearly_the_nearest_sample(bumpy):
    grid = NearestGrid.of(bumpy, cell=5.0, margin=30.0)
    rng = np.random.default_rng(0)
    probes = rng.uniform(bumpy.points.min(0) - 25, bumpy.points.max(0) + 25, (2000, 3))
    found = np.linalg.norm(bumpy.points[looked_up(grid, probes)] - probes, axis=1)
    farther = found - bumpy.tree.query(probes)[0]
    # Half a cell's diagonal is what looking up instead of searching may cost.
    assert farther.max() < 5.0 * np.sqrt(3)
    assert farther.mean() < 1.0


def test_a_huge_box_gets_larger_cells_not_more_memory():
    far = OrientedPoints(np.array([[0.0, 0, 0], [1e5, 1e5, 1e5]]), np.eye(3)[:2], np.ones(2))
    grid = NearestGrid.of(far, cell=5.0, margin=40.0)
    assert grid.nearest.size < 2_000_000
    assert looked_up(grid, far.points).tolist() == [0, 1]
