"""Key points from views: exact, noisy, with outliers and gaps."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.eyeglasses import triangulate
from scan2albedo.geometry.rigid import rotation_from_vector
from scan2albedo.synthetic import eyeglasses


def ring_of_cameras(count, focal_px=1800.0, distance_mm=600.0):
    cameras = []
    for angle in np.linspace(-0.8, 0.8, count):
        rotation = rotation_from_vector([0.15 * np.cos(7 * angle), angle, 0]) @ np.diag([1.0, -1, -1])
        placed = np.column_stack([rotation, [0, 0, distance_mm]])
        cameras.append(np.array([[focal_px, 0, 512], [0, focal_px, 512], [0, 0, 1]]) @ placed)
    return np.array(cameras)


def seen_by(cameras, points):
    image = np.einsum("cij,kj->cki", cameras[:, :, :3], points) + cameras[:, None, :, 3]
    return image[..., :2] / image[..., 2:]


POINTS = eyeglasses(1).keypoints


@pytest.mark.parametrize("count", [2, 3, 6])
def test_exact_labels_give_exact_points(count):
    cameras = ring_of_cameras(count)
    found = triangulate(seen_by(cameras, POINTS), cameras)
    assert_allclose(found.points, POINTS, atol=1e-8)
    assert found.errors_px.max() < 1e-6
    assert found.inliers.all()


def test_scale_and_sign_of_cameras_do_not_matter():
    cameras = ring_of_cameras(3)
    labels = seen_by(cameras, POINTS) + np.random.default_rng(0).normal(0, 1, (3, 20, 2))
    scaled = cameras * np.array([2.0, -0.1, 30])[:, None, None]
    assert_allclose(triangulate(labels, scaled).points, triangulate(labels, cameras).points, atol=1e-6)


@pytest.mark.parametrize("count", [3, 6])
def test_noise_is_not_amplified(count):
    cameras = ring_of_cameras(count)
    rng = np.random.default_rng(2)
    labels = seen_by(cameras, POINTS) + rng.normal(0, 1, (count, 20, 2))
    found = triangulate(labels, cameras)
    # A pixel is a third of a millimetre at 600 mm.
    assert np.sqrt(np.mean((found.points - POINTS) ** 2)) < 0.4
    assert np.nanmax(found.errors_px) < 5


@pytest.mark.parametrize("seed", range(4))
def test_outliers_are_outvoted_and_named(seed):
    rng = np.random.default_rng(seed)
    cameras = ring_of_cameras(6)
    labels = seen_by(cameras, POINTS) + rng.normal(0, 1, (6, 20, 2))
    wrong = np.zeros((6, 20), bool)
    for k in range(20):
        wrong[rng.choice(6, 2, replace=False), k] = True
    labels[wrong] += rng.choice([-1, 1], (wrong.sum(), 2)) * rng.uniform(60, 300, (wrong.sum(), 2))
    found = triangulate(labels, cameras)
    assert np.linalg.norm(found.points - POINTS, axis=1).max() < 2.5
    assert not found.inliers[wrong].any()
    assert found.inliers[~wrong].mean() > 0.97


def test_missing_labels_leave_gaps_only_where_fewer_than_two_views_see():
    cameras = ring_of_cameras(4)
    labels = seen_by(cameras, POINTS)
    labels[1:, 3] = np.nan
    labels[:, 7] = np.nan
    labels[[0, 2], 11] = np.nan
    found = triangulate(labels, cameras)
    lost = np.isnan(found.points).all(1)
    assert np.flatnonzero(lost).tolist() == [3, 7]
    assert_allclose(found.points[~lost], POINTS[~lost], atol=1e-8)
    assert_array_equal(np.isnan(found.errors_px), np.isnan(labels).any(2) | lost)
    assert not found.inliers[:, lost].any()


def test_views_from_one_place_see_no_depth():
    camera = ring_of_cameras(3)[:1]
    cameras = np.concatenate([camera, camera])
    found = triangulate(seen_by(cameras, POINTS), cameras)
    assert np.isnan(found.points).all()
    assert np.isnan(found.errors_px).all()
    assert not found.inliers.any()


def test_misuse_is_a_value_error():
    cameras = ring_of_cameras(2)
    with pytest.raises(ValueError, match=r"cameras is .* expected \(3, 3, 4\)"):
        triangulate(np.zeros((3, 20, 2)), cameras)
    with pytest.raises(ValueError, match="labels_2d"):
        triangulate(np.zeros((20, 2)), cameras)
    with pytest.raises(ValueError, match="camera 1 has a singular"):
        triangulate(np.zeros((2, 20, 2)), [cameras[0], np.zeros((3, 4))])
    for noise_px in (0, np.nan):
        with pytest.raises(ValueError, match="noise_px"):
            triangulate(np.zeros((2, 20, 2)), cameras, noise_px=noise_px)
