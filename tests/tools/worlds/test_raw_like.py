from __future__ import annotations

import numpy as np
import pytest
from worlds.raw_like import raw_like

from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import face_areas, face_normals, vertex_components
from scan2albedo.geometry.rigid import rotation_angle_rad, transform_points

BARE = {"hair": False, "shoulders": False, "crumbs": 0, "spikes": 0, "holes": 0, "spacing_mm": 4.0}


def in_shape_frame(scan, scan_from_shape):
    return transform_points(np.linalg.inv(scan_from_shape), scan.vertices)


def test_same_seed_same_scan_and_another_seed_another(head):
    first, pose = raw_like(*head, seed=3, **BARE)
    again, same_pose = raw_like(*head, seed=3, **BARE)
    other, other_pose = raw_like(*head, seed=4, **BARE)
    assert np.array_equal(first.vertices, again.vertices)
    assert np.array_equal(pose, same_pose)
    assert not np.allclose(pose, other_pose)
    assert len(first.vertices) != len(other.vertices) or not np.allclose(first.vertices, other.vertices)


def test_noise_is_the_only_distance_to_the_shape(head):
    scan, pose = raw_like(*head, seed=1, **BARE)
    distance = ClosestPointQuery(*head).query(in_shape_frame(scan, pose)).distance
    assert distance.mean() == pytest.approx(0.2 * np.sqrt(2 / np.pi), rel=0.1)
    assert distance.max() < 1.0


def test_faces_look_outward_and_the_back_is_not_seen(head):
    scan, pose = raw_like(*head, seed=1, **BARE)
    points = in_shape_frame(scan, pose)
    centers = points[scan.faces].mean(1)
    normals = face_normals(points, scan.faces)
    assert np.mean(np.einsum("ij,ij->i", normals, centers) > 0) > 0.99
    assert points[:, 2].min() > -60
    assert points[:, 2].max() > 110


def test_triangulation_is_irregular_and_not_the_models(head):
    scan, pose = raw_like(*head, seed=1, **BARE)
    areas = face_areas(scan.vertices, scan.faces)
    assert areas.min() > 0
    assert areas.std() / areas.mean() > 0.3
    exact = ClosestPointQuery(*head).query(in_shape_frame(scan, pose)).barycentric.max(1)
    assert np.mean(exact > 0.999) < 0.01


def test_pose_and_unit_follow_the_options(head):
    pose_and_unit = {"rotation_max_deg": 10.0, "translation_max_mm": 5.0, "scale": 0.1}
    scan, pose = raw_like(*head, seed=5, **BARE, **pose_and_unit)
    assert np.ptp(scan.vertices, axis=0).max() < 25
    assert np.rad2deg(rotation_angle_rad(pose[:3, :3] / 0.1)) <= 10
    assert np.abs(pose[:3, 3]).max() <= 0.5


def test_clutter_adds_hair_above_shoulders_below_and_crumbs(head):
    scan, pose = raw_like(*head, seed=2)
    points = in_shape_frame(scan, pose)
    bare, bare_pose = raw_like(*head, seed=2, **BARE)
    bare_points = in_shape_frame(bare, bare_pose)
    assert points[:, 1].max() > bare_points[:, 1].max() + 5
    assert points[:, 1].min() < bare_points[:, 1].min() - 60
    assert len(np.unique(vertex_components(len(scan.vertices), scan.faces))) >= 5
    assert np.bincount(vertex_components(len(scan.vertices), scan.faces)).max() > 0.6 * len(points)


def test_holes_and_spikes_are_there(head):
    holed, _ = raw_like(*head, seed=2, **{**BARE, "holes": 12})
    spiky, pose = raw_like(*head, seed=2, **{**BARE, "spikes": 25})
    whole, _ = raw_like(*head, seed=2, **BARE)
    assert len(holed.faces) < len(whole.faces) - 100
    distance = ClosestPointQuery(*head).query(in_shape_frame(spiky, pose)).distance
    assert 15 <= np.sum(distance > 2) <= 25
