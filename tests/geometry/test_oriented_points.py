"""Samples of a surface: even, denoised, indifferent to the tessellation; and how noisy it is."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from helpers.meshes import grid, sphere
from scipy.spatial import cKDTree

from scan2albedo.geometry.mesh import normalized, vertex_normals
from scan2albedo.geometry.oriented_points import SurfaceNoise, anchors, farthest_points, oriented_points


@pytest.mark.parametrize("level", [3, 5, 6, 8])  # 8 has more than a million faces: some are read
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
    noisy = vertices * np.random.default_rng(1).normal(1, 0.3 / 60, (len(vertices), 1))
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
    nothing = oriented_points(np.zeros((3, 3)), np.array([[0, 1, 2]]), 4.0)
    assert nothing.points.shape == (0, 3)
    assert anchors(nothing, spacing=30.0, limit=20, reach=45.0).normals.shape == (0, 3)


def test_farthest_points_keep_their_distance_and_cover_the_cloud():
    points = np.random.default_rng(2).uniform(0, 100, (2000, 3))
    chosen = points[farthest_points(points, 20.0, 1000)]
    pairs = np.linalg.norm(chosen[:, None] - chosen[None], axis=2) + 1e9 * np.eye(len(chosen))
    assert pairs.min() >= 20
    assert cKDTree(chosen).query(points)[0].max() < 20
    assert len(farthest_points(points, 1.0, 10)) == 10


def test_anchors_look_outward_whatever_single_normals_do():
    samples = oriented_points(*sphere(5, 60.0), 4.0)
    shaken = normalized(np.random.default_rng(3).normal(samples.normals, 0.3))
    spread = anchors(replace(samples, normals=shaken), spacing=30.0, limit=20, reach=30.0)
    assert len(spread) == 20
    assert np.einsum("ij,ij->i", spread.normals, normalized(spread.points)).min() > 0.98


@pytest.fixture(scope="module")
def ball():
    return sphere(4, 90.0)


def _noisy(ball, noise_mm):
    return ball[0] * np.random.default_rng(7).normal(1, noise_mm / 90, (len(ball[0]), 1))


@pytest.mark.parametrize("noise_mm", [0.3, 1.0, 3.0])
def test_noise_is_measured(ball, noise_mm):
    noise = SurfaceNoise.of(_noisy(ball, noise_mm), ball[1])
    found_mm, area_mm2 = noise.among(np.ones(len(ball[0]), bool))
    assert found_mm == pytest.approx(noise_mm, rel=0.15)
    assert area_mm2 * len(ball[0]) == pytest.approx(noise.area.sum())


def test_only_the_chosen_vertices_count_and_a_smooth_surface_has_hardly_any(ball):
    front = ball[0][:, 2] > 0
    points = np.where(front[:, None], _noisy(ball, 2.0), ball[0])
    noise = SurfaceNoise.of(points, ball[1])
    assert noise.among(ball[0][:, 2] > 20)[0] > 1.5
    assert noise.among(ball[0][:, 2] < -20)[0] < 0.15


def test_few_vertices_and_loose_triangles_say_nothing(ball):
    assert SurfaceNoise.of(*ball).among(np.arange(len(ball[0])) < 10) == (0.0, 0.0)
    points = np.random.default_rng(1).normal(scale=50, size=(90, 3))
    noise = SurfaceNoise.of(points, np.arange(90).reshape(30, 3))
    assert np.isnan(noise.gap).all()
    assert noise.among(np.ones(90, bool)) == (0.0, 0.0)
