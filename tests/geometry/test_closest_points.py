import numpy as np
import pytest
from helpers.meshes import grid
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.geometry.closest_points import (
    ClosestPointQuery,
    NearestSurface,
    walk_downhill,
    weights_nearest_origin,
)
from scan2albedo.geometry.mesh import join

VERTICES, FACES = grid(30, 30)
X, Y, _ = 10 * VERTICES.T
VERTICES = np.column_stack([X, Y, np.sin(2 * X) * np.cos(3 * Y)])
"""A square of 10 mm with bumps."""


def test_barycentric_coordinates_rebuild_the_points():
    points = np.random.default_rng(1).uniform([0, 0, -2], [10, 10, 2], (200, 3))
    for query in (ClosestPointQuery, NearestSurface):
        hits = query(VERTICES, FACES).query(points)
        rebuilt = np.einsum("nk,nkj->nj", hits.barycentric, VERTICES[FACES[hits.face]])
        assert_allclose(rebuilt, hits.points, atol=1e-9)
        assert_allclose(np.linalg.norm(points - hits.points, axis=1), hits.distance, atol=1e-9)


def test_nearest_surface_is_exact_near_a_well_shaped_mesh():
    rng = np.random.default_rng(2)
    base = VERTICES[FACES[rng.integers(len(FACES), size=500)]].mean(1)
    points = base + 0.1 * rng.normal(size=base.shape)
    exact = ClosestPointQuery(VERTICES, FACES).query(points).distance
    near = NearestSurface(VERTICES, FACES).query(points).distance
    assert (near >= exact - 1e-12).all()
    assert np.mean(near - exact < 1e-9) > 0.95


def test_a_walk_downhill_ends_at_the_vertex_of_a_full_search():
    vertices = VERTICES * [1, 1, 0.2]
    surface = NearestSurface(vertices, FACES)
    points = vertices[FACES].mean(1)
    moved, before = points + [0.2, -0.1, 0.05], surface.nearest_vertices(points)
    xyz, _, _, _, near, near_start = surface.arrays
    found = [walk_downhill(place, v, xyz, near, near_start) for place, v in zip(moved, before, strict=True)]
    nearest = surface.nearest_vertices(moved)
    assert (nearest != before).any()
    assert_array_equal(found, nearest)


def test_one_triangle_in_every_voronoi_region():
    triangle = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]])
    points = [[-1, -1, 0], [2, -1, 0], [-1, 2, 0], [0.5, -1, 0], [-1, 0.5, 0], [1, 1, 0], [0.2, 0.2, 3]]
    near, exact = (query(*triangle).query(points).points for query in (NearestSurface, ClosestPointQuery))
    assert_allclose(near, exact, atol=1e-12)


def test_query_facing_chooses_the_sheet_that_looks_the_right_way():
    sheet, faces = grid(8, 8)
    query = ClosestPointQuery(*join([(10 * sheet, faces), (10 * sheet + [0, 0, 0.1], faces[:, ::-1])]))
    assert query.query([[5.0, 5.0, 0.09]]).distance == pytest.approx(0.01)
    hit = query.query_facing([[5.0, 5.0, 0.09]], [[0, 0, 1]])
    assert hit.distance == pytest.approx(0.09)
    assert hit.points[0] == pytest.approx([5, 5, 0])


def test_triangles_without_area_or_with_coincident_corners_have_closest_points_too():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [1, 0, 0], [0, 0, 0], [0, 0, 0], [2, 0, 0]])
    faces = np.array([[0, 1, 2], [0, 3, 4], [3, 1, 5]])
    points = np.array([[0.0, 0, 0], [0.5, 1, 0], [1, 0, 0], [0, 0, 2], [3, 0, 1], [1.8, 1, 0]])
    for query in (ClosestPointQuery, NearestSurface):
        hits = query(vertices, faces).query(points)
        assert_allclose(hits.distance, [0, 1, 0, 2, np.sqrt(2), 1])
        assert_allclose(hits.barycentric.sum(1), 1)
    for corners in vertices[faces]:
        for order in ([0, 1, 2], [1, 2, 0], [2, 0, 1], [0, 2, 1]):
            for point in (points[1], corners[0]):
                weights = weights_nearest_origin(*(corners[order] - point))
                assert sum(weights) == pytest.approx(1)


def test_no_points_have_no_answers():
    assert ClosestPointQuery(*grid(4, 4)).query(np.empty((0, 3))).distance.shape == (0,)
