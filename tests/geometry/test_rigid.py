"""Rigid transforms against closed forms and their own inverses."""

import numpy as np
import pytest
from helpers.meshes import sphere
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.geometry import rigid


def test_rotation_by_a_quarter_turn_about_z():
    quarter = rigid.rotation_from_vector([0, 0, np.pi / 2])
    assert_allclose(quarter @ [1, 0, 0], [0, 1, 0], atol=1e-15)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, np.pi - 1e-3, np.pi - 1e-9, np.pi])
def test_rotation_angle_is_accurate_at_both_ends(angle):
    axis = np.array([1.0, 2.0, -2.0]) / 3
    measured = rigid.rotation_angle_rad(rigid.rotation_from_vector(angle * axis))
    assert measured == pytest.approx(angle, abs=1e-12)


def test_inverse_and_composition():
    rng = np.random.default_rng(0)
    pose = rigid.compose(rigid.random_rotation(rng), rng.normal(size=3))
    assert_allclose(rigid.invert_rigid(pose) @ pose, np.eye(4), atol=1e-14)
    points = rng.normal(size=(7, 3))
    moved = rigid.transform_points(pose, points)
    assert_allclose(rigid.transform_points(rigid.invert_rigid(pose), moved), points, atol=1e-14)
    assert_allclose(rigid.transform_directions(pose, points), moved - pose[:3, 3], atol=1e-14)


def test_super_fibonacci_rotations_leave_no_gap_and_do_not_crowd():
    rotations = rigid.super_fibonacci_rotations(300)
    assert_allclose(rotations @ rotations.transpose(0, 2, 1), [np.eye(3)] * 300, atol=1e-12)
    rng = np.random.default_rng(1)

    def cosines(others):
        return (np.einsum("pij,nij->pn", others, rotations) - 1) / 2

    assert cosines([rigid.random_rotation(rng) for _ in range(500)]).max(1).min() > np.cos(np.deg2rad(40))
    assert (cosines(rotations) - 2 * np.eye(300)).max() < np.cos(np.deg2rad(15))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("reach_mm", [300.0, 1e6])
def test_a_lump_in_any_pose_has_the_same_coordinates_in_its_principal_frame(seed, reach_mm):
    unit, faces = sphere(3, 1.0)
    vertices = unit * [50.0, 70.0, 90.0] * (1 + 0.3 * np.clip(unit @ [0.6, 0.5, 0.62], 0, 1))[:, None] ** 2
    rng = np.random.default_rng(seed)
    pose = rigid.compose(rigid.random_rotation(rng), rng.uniform(-reach_mm, reach_mm, 3))
    rest, prepared_from_rest = rigid.in_principal_frame(vertices, faces)
    assert_allclose(rigid.transform_points(prepared_from_rest, vertices), rest, atol=1e-10)
    moved, prepared_from_scan = rigid.in_principal_frame(rigid.transform_points(pose, vertices), faces)
    assert_allclose(moved, rest, atol=1e-14 * reach_mm + 1e-9)
    assert rigid.is_rigid(prepared_from_scan, 1e-12)


def test_a_surface_without_area_is_only_moved():
    moved, prepared_from_scan = rigid.in_principal_frame(np.full((3, 3), 7.0), np.array([[0, 1, 2]]))
    assert not moved.any()
    assert_array_equal(prepared_from_scan[:3, :3], np.eye(3))


@pytest.mark.parametrize(("scale", "center", "rounded"), [(1.0, 0, 1e-12), (0.3, 0, 1e-12), (1.0, 1e6, 1e-6)])
def test_procrustes_finds_the_transform_that_made_the_points(scale, center, rounded):
    rng = np.random.default_rng(3)
    source = rng.normal(center, 1, (20, 3))
    truth = rigid.compose(scale * rigid.random_rotation(rng), [5 + center, -2, 1])
    target = rigid.transform_points(truth, source)
    found = rigid.procrustes(source, target, scale=scale != 1)
    assert_allclose(rigid.transform_points(found, source), target, rtol=0, atol=rounded)
    assert_allclose(found[:3, :3], truth[:3, :3], atol=rounded)


def test_procrustes_never_mirrors():
    source = np.random.default_rng(4).normal(size=(10, 3))
    assert rigid.is_rigid(rigid.procrustes(source, source * [-1, 1, 1]))


def test_procrustes_weights_silence_outliers():
    source = np.random.default_rng(5).normal(size=(10, 3))
    target = source + [1, 0, 0]
    target[0] += 100
    found = rigid.procrustes(source, target, weights=np.r_[0.0, np.ones(9)])
    assert_allclose(found, rigid.compose(np.eye(3), [1, 0, 0]), atol=1e-12)


def test_procrustes_names_shapes_that_do_not_agree():
    with pytest.raises(ValueError, match=r"\(3, 3\) and target \(4, 3\)"):
        rigid.procrustes(np.zeros((3, 3)), np.zeros((4, 3)))
