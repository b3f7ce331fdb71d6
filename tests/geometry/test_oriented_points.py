"""Samples of a surface: even, denoised, indifferent to the tessellation."""

import numpy as np
import pytest
import trimesh
from helpers.meshes import grid, sphere
from scipy.spatial import cKDTree

from scan2albedo.geometry.mesh import normalized, vertex_normals
from scan2albedo.geometry.oriented_points import OrientedPoints, anchors, farthest_points, oriented_points


@pytest.mark.parametrize("level", [3, 5, 6])
def test_samples_of_a_sphere_lie_on_it_with_radial_normals_and_its_area(level):
    samples = oriented_points(*sphere(level, 60.0), 4.0)
    radius = np.linalg.norm(samples.points, axis=1)
    assert np.abs(radius - 60).max() < 1.0
    assert np.einsum("ij,ij->i", samples.normals, samples.points / radius[:, None]).min() > 0.98
    assert samples.areas.sum() == pytest.approx(4 * np.pi * 60**2, rel=0.02)
    assert 0.5 * samples.areas.sum() / 16 < len(samples) < 2.5 * samples.areas.sum() / 16


def test_two_large_triangles_are_sampled_without_holes():
    corners, faces = grid(2, 2)
    samples = oriented_points(60 * corners, faces, 5.0)
    np.testing.assert_allclose(samples.normals, [[0, 0, 1.0]] * len(samples), atol=1e-12)
    probes = np.random.default_rng(0).uniform(0, 60, (500, 2))
    distance, _ = cKDTree(samples.points[:, :2]).query(probes)
    assert distance.max() < 7.5


def test_noise_on_a_fine_mesh_is_averaged_away():
    vertices, faces = sphere(6, 60.0)
    rng = np.random.default_rng(1)
    noisy = vertices * (1 + rng.normal(scale=0.3 / 60, size=(len(vertices), 1)))
    samples = oriented_points(noisy, faces, 6.0)
    cosine = np.einsum("ij,ij->i", samples.normals, samples.points) / np.linalg.norm(samples.points, axis=1)
    raw = np.einsum("ij,ij->i", vertex_normals(noisy, faces), vertices / 60)
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    assert np.average(angle, weights=samples.areas) < 0.5 * np.degrees(np.arccos(raw)).mean()


def test_the_two_sides_of_a_thin_sheet_cancel():
    sheet = trimesh.creation.box((60.0, 60.0, 1e-3)).subdivide().subdivide().subdivide().subdivide()
    vertices = np.asarray(sheet.vertices) + 0.5
    assert oriented_points(vertices, np.asarray(sheet.faces), 8.0).areas.sum() < 0.2 * sheet.area


def test_nothing_comes_from_faces_without_area():
    samples = oriented_points(np.zeros((3, 3)), np.array([[0, 1, 2]]), 4.0)
    assert samples.points.shape == (0, 3)


def test_a_large_mesh_keeps_its_area_when_only_some_faces_are_read():
    vertices, faces = sphere(8, 60.0)
    samples = oriented_points(vertices, faces, 6.0)
    assert len(faces) > 1_000_000
    assert samples.areas.sum() == pytest.approx(4 * np.pi * 60**2, rel=0.02)


def test_farthest_points_keep_their_distance_and_cover_the_cloud():
    points = np.random.default_rng(2).uniform(0, 100, (2000, 3))
    chosen = points[farthest_points(points, 20.0, 1000)]
    pairs = np.linalg.norm(chosen[:, None] - chosen[None], axis=2) + 1e9 * np.eye(len(chosen))
    assert pairs.min() >= 20
    assert cKDTree(chosen).query(points)[0].max() < 20
    assert len(farthest_points(points, 1.0, 10)) == 10


def test_anchors_look_outward_whatever_single_normals_do():
    samples = oriented_points(*sphere(5, 60.0), 4.0)
    rng = np.random.default_rng(3)
    shaken = normalized(samples.normals + rng.normal(scale=0.3, size=samples.normals.shape))
    spread = anchors(
        OrientedPoints(samples.points, shaken, samples.areas), spacing=30.0, limit=20, reach=30.0
    )
    assert len(spread) == 20
    assert np.einsum("ij,ij->i", spread.normals, normalized(spread.points)).min() > 0.98


def test_no_samples_have_no_anchors():
    nothing = oriented_points(np.zeros((3, 3)), np.array([[0, 1, 2]]), 4.0)
    assert anchors(nothing, spacing=30.0, limit=20, reach=45.0).normals.shape == (0, 3)
