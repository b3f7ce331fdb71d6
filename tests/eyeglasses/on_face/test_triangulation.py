"""Key points from views: exact, noisy, with outliers and gaps."""

import numpy as np
import pytest
from helpers.measures import rms, row_lengths
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.eyeglasses import triangulate
from scan2albedo.geometry.pinhole import look_at, project
from scan2albedo.synthetic import eyeglasses


def ring_of_cameras(count):
    angle = np.linspace(-0.8, 0.8, count)
    eyes = 600 * np.stack([np.sin(angle), 0.15 * np.cos(7 * angle), np.cos(angle)], 1)
    return np.stack([look_at(eye, np.zeros(3), focal_px=1800, shape=(1024, 1024)) for eye in eyes])


POINTS = eyeglasses(1).keypoints


def labels_of(cameras, noise_px=0.0, seed=0):
    """Return pixels (C, 20, 2) of the key points, with noise."""
    exact = np.stack([project(camera, POINTS)[0] for camera in cameras])
    return exact + noise_px * np.random.default_rng(seed).normal(size=exact.shape)


@pytest.mark.parametrize("count", [2, 3, 6])
def test_exact_labels_give_exact_points(count):
    cameras = ring_of_cameras(count)
    found = triangulate(labels_of(cameras), cameras)
    assert_allclose(found.points, POINTS, atol=1e-8)
    assert found.errors_px.max() < 1e-6
    assert found.inliers.all()


@pytest.mark.parametrize("count", [3, 6])
def test_noise_is_not_amplified(count):
    cameras = ring_of_cameras(count)
    found = triangulate(labels_of(cameras, 1.0, seed=2), cameras)
    # A pixel is a third of a millimetre at 600 mm.
    assert rms(found.points - POINTS) < 0.4
    assert np.nanmax(found.errors_px) < 5


@pytest.mark.parametrize("seed", range(4))
def test_outliers_are_outvoted_and_named(seed):
    rng = np.random.default_rng(seed)
    cameras = ring_of_cameras(6)
    labels = labels_of(cameras, 1.0, seed)
    # Two of the six views of each point.
    wrong = rng.random((6, 20)).argsort(0) < 2
    labels[wrong] += rng.choice([-1, 1], (wrong.sum(), 2)) * rng.uniform(60, 300, (wrong.sum(), 2))
    found = triangulate(labels, cameras)
    assert row_lengths(found.points - POINTS).max() < 2.5
    assert not found.inliers[wrong].any()
    assert found.inliers[~wrong].mean() > 0.97


def test_missing_labels_leave_gaps_only_where_fewer_than_two_views_see():
    cameras = ring_of_cameras(4)
    labels = labels_of(cameras)
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
    cameras = ring_of_cameras(3)[[0, 0]]
    found = triangulate(labels_of(cameras), cameras)
    assert np.isnan(found.points).all()
    assert np.isnan(found.errors_px).all()
    assert not found.inliers.any()


@pytest.mark.parametrize(
    ("shape", "changes", "words"),
    [
        ((3, 20, 2), {}, r"cameras is .* expected \(3, 3, 4\)"),
        ((20, 2), {}, "labels_2d"),
        ((2, 20, 2), {"cameras": [np.eye(3, 4), np.zeros((3, 4))]}, "camera 1 has a singular"),
        ((2, 20, 2), {"noise_px": 0}, "noise_px"),
    ],
)
def test_misuse_is_a_value_error(shape, changes, words):
    with pytest.raises(ValueError, match=words):
        triangulate(np.zeros(shape), **{"cameras": ring_of_cameras(2), **changes})
