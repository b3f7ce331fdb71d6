"""ICP finds pose and size, and outliers do not move it."""

import numpy as np
import pytest
from helpers.poses import REST
from numpy.testing import assert_allclose

from scan2albedo.geometry.oriented_points import OrientedPoints
from scan2albedo.geometry.rigid import Similarity, random_rotation, rotation_from_vector
from scan2albedo.registration.icp import icp, residuals, rigid_distance_mm


def scan_of(samples, pose):
    points = pose.scale * samples.points @ pose.rotation.T + pose.translation
    return OrientedPoints(points, samples.normals @ pose.rotation.T, samples.areas)


@pytest.mark.parametrize("scale", [0.9, 1.0, 1.1])
def test_pose_and_size_are_recovered(template, scale):
    truth = Similarity(random_rotation(np.random.default_rng(0)), np.array([3.0, -9.0, 4.0]), scale)
    scan = scan_of(template.samples, truth)
    start = Similarity(
        rotation_from_vector([0.05, -0.06, 0.04]) @ truth.rotation, truth.translation + [3.0, 2.0, -4.0]
    )
    found = icp(scan, template, start, np.geomspace(6.0, 1.0, 40)).pose
    assert found.is_near(truth, np.radians(0.3), 0.5)
    assert found.scale == pytest.approx(scale, abs=0.01)
    assert residuals(scan, template.samples, found).trimmed_rms_mm(template.samples.areas) < 0.2


def test_a_raised_tenth_of_the_surface_does_not_pull(template):
    scan = template.samples
    raised = scan.points[:, 1] > np.quantile(scan.points[:, 1], 0.9)
    points = scan.points + 12 * raised[:, None] * scan.normals
    target = OrientedPoints(points, scan.normals, scan.areas)
    start = Similarity(rotation_from_vector([0.03, 0.02, 0.0]), np.array([2.0, 1.0, 2.0]))
    found = icp(target, template, start, np.geomspace(4.0, 1.0, 30)).pose
    assert found.is_near(REST, np.radians(0.7), 1.0)


def test_similarity_and_its_inverse():
    pose = Similarity(random_rotation(np.random.default_rng(1)), np.array([1.0, 2.0, 3.0]), 1.07)
    assert_allclose(pose.inverse() @ pose.matrix(), np.eye(4), atol=1e-14)
    assert_allclose(pose.rigid()[:3, 3], pose.matrix()[:3, 3])
    assert np.linalg.det(pose.rigid()[:3, :3]) == pytest.approx(1)


def test_without_its_scale_a_similarity_keeps_a_point():
    pose = Similarity(random_rotation(np.random.default_rng(2)), np.array([1.0, 2.0, 3.0]), 1.1)
    nose = np.array([1.0, -2.0, 40.0])
    rigid = pose.rigid(nose)
    assert_allclose(pose.apply(nose[None])[0], rigid[:3, :3] @ nose + rigid[:3, 3])
    again = Similarity.of_rigid(rigid, 1.1, nose)
    assert_allclose(again.matrix(), pose.matrix(), atol=1e-12)


def test_nothing_near_is_an_infinite_rms_and_the_worst_cost(template):
    scan = scan_of(template.samples, Similarity(np.eye(3), np.array([1e5, 0, 0])))
    far, areas = residuals(scan, template.samples, REST), template.samples.areas
    assert far.trimmed_rms_mm(areas) == far.quantile_mm(areas, 0.3) == np.inf
    assert rigid_distance_mm(scan, template, REST, 2.0) == pytest.approx(6.0)


def test_a_settled_pose_does_not_depend_on_where_it_began(template):
    truth = Similarity(random_rotation(np.random.default_rng(4)), np.array([1.0, 5.0, -2.0]))
    scan = scan_of(template.samples, truth)
    ends = []
    for turn, shift in ([0.02, -0.01, 0.0], [1.0, 0, 0]), ([-0.01, 0.02, 0.01], [0, -1.0, 0.5]):
        start = Similarity(rotation_from_vector(turn) @ truth.rotation, truth.translation + shift)
        found = icp(scan, template, start, 60 * [3.0], settled=1e-3)
        assert found.converged
        assert found.steps < 60
        assert found.moved < 1e-3
        ends.append(found.pose)
    assert ends[0].is_near(ends[1], np.radians(0.01), 0.01)


def test_the_quantile_of_the_distances(template):
    samples = template.samples
    lifted = residuals(samples, samples, Similarity(np.eye(3), np.array([0.0, 0.0, 0.4])))
    assert lifted.quantile_mm(samples.areas, 0.3) <= lifted.quantile_mm(samples.areas, 0.9) <= 0.41
