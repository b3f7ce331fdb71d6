"""A scan of any head as scanners see it: noise, gaps, clutter, another triangulation, any pose."""

import numpy as np
import pytest
from helpers.meshes import sphere
from worlds.raw_like import raw_like

from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import face_areas, face_normals, vertex_components
from scan2albedo.geometry.rigid import rotation_angle_rad, transform_points

BARE = {"hair": False, "shoulders": False, "crumbs": 0, "spikes": 0, "holes": 0, "spacing_mm": 4.0}


@pytest.fixture(scope="module")
def head():
    """An ellipsoid with a nose on +z: the least that raw_like needs."""
    unit, faces = sphere(5, 1.0)
    vertices = unit * [74.0, 110.0, 95.0]
    nose = np.exp(-((vertices[:, 0] / 12) ** 2) - ((vertices[:, 1] + 10) / 20) ** 2)
    vertices[:, 2] += 22 * nose * (vertices[:, 2] > 0)
    return vertices, faces


def scanned(head, **options):
    """Return a scan's points in the frame of the shape, and its faces."""
    scan, scan_from_shape = raw_like(*head, seed=1, **options)
    return transform_points(np.linalg.inv(scan_from_shape), scan.vertices), scan.faces


@pytest.fixture(scope="module")
def bare(head):
    return scanned(head, **BARE)


def test_same_seed_same_scan_and_another_seed_another(head):
    (first, pose), (again, same_pose), (_, other_pose) = (raw_like(*head, seed=n, **BARE) for n in (3, 3, 4))
    assert np.array_equal(first.vertices, again.vertices)
    assert np.array_equal(pose, same_pose)
    assert not np.allclose(pose, other_pose)


def test_noise_is_the_only_distance_to_the_shape_whose_triangles_are_others(head, bare):
    hits = ClosestPointQuery(*head).query(bare[0])
    assert hits.distance.mean() == pytest.approx(0.2 * np.sqrt(2 / np.pi), rel=0.1)
    assert hits.distance.max() < 1.0
    assert np.mean(hits.barycentric.max(1) > 0.999) < 0.01
    areas = face_areas(*bare)
    assert areas.min() > 0
    assert areas.std() / areas.mean() > 0.3


def test_faces_look_outward_and_the_back_is_not_seen(bare):
    points, faces = bare
    outward = np.einsum("ij,ij->i", face_normals(points, faces), points[faces].mean(1))
    assert np.mean(outward > 0) > 0.99
    assert points[:, 2].min() > -60
    assert points[:, 2].max() > 110


def test_pose_and_unit_follow_the_options(head):
    pose_and_unit = {"rotation_max_deg": 10.0, "translation_max_mm": 5.0, "scale": 0.1}
    scan, pose = raw_like(*head, seed=5, **BARE, **pose_and_unit)
    assert np.ptp(scan.vertices, axis=0).max() < 25
    assert np.rad2deg(rotation_angle_rad(pose[:3, :3] / 0.1)) <= 10
    assert np.abs(pose[:3, 3]).max() <= 0.5


def test_clutter_adds_hair_above_shoulders_below_and_crumbs(head, bare):
    points, faces = scanned(head)
    assert points[:, 1].max() > bare[0][:, 1].max() + 5
    assert points[:, 1].min() < bare[0][:, 1].min() - 60
    sizes = np.bincount(vertex_components(len(points), faces))
    assert len(sizes) >= 5
    assert sizes.max() > 0.6 * len(points)


def test_holes_and_spikes_are_there(head, bare):
    assert len(scanned(head, **BARE | {"holes": 12})[1]) < len(bare[1]) - 100
    spiky, _ = scanned(head, **BARE | {"spikes": 25})
    assert 15 <= np.sum(ClosestPointQuery(*head).query(spiky).distance > 2) <= 25
