"""Starting poses face outward and reach every part of a scan."""

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from scan2albedo.registration.coarse_search import anchored_starts, farthest_points
from scan2albedo.registration.oriented_points import oriented_points


def test_starts_on_a_sphere_face_outward_everywhere():
    mesh = trimesh.creation.icosphere(4, 90.0)
    scan = oriented_points(np.asarray(mesh.vertices), np.asarray(mesh.faces), 5.0)
    front = np.array([1.0, 2.0, 40.0])
    starts = anchored_starts(scan, front, rotation_count=300, anchor_spacing_mm=30.0)
    on_surface = np.einsum("nij,j->ni", starts.rotations, front) + starts.translations
    outward = on_surface / np.linalg.norm(on_surface, axis=1, keepdims=True)
    cosine = np.einsum("ni,ni->n", outward, starts.rotations[:, :, 2])
    assert np.degrees(np.arccos(cosine.min())) < 36.5
    directions = np.random.default_rng(0).normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    assert np.degrees(np.arccos((directions @ outward.T).max(1).min())) < 25
    # Every anchor is tried at several roll angles.
    assert len(starts) > 10 * len(np.unique(on_surface.round(3), axis=0))


def test_farthest_points_keep_their_distance_and_cover_the_cloud():
    points = np.random.default_rng(2).uniform(0, 100, (2000, 3))
    chosen = points[farthest_points(points, 20.0, 1000)]
    pairs = np.linalg.norm(chosen[:, None] - chosen[None], axis=2) + 1e9 * np.eye(len(chosen))
    assert pairs.min() >= 20
    assert cKDTree(chosen).query(points)[0].max() < 20
    assert len(farthest_points(points, 1.0, 10)) == 10
