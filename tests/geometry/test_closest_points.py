import igl
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
from scan2albedo.geometry.mesh import vertex_normals

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


@pytest.mark.parametrize(
    "point", [[-1, -1, 0], [2, -1, 0], [-1, 2, 0], [0.5, -1, 0], [1, 1, 0], [0.2, 0.2, 3]]
)
def test_one_triangle_in_every_voronoi_region(point):
    vertices, faces = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]])
    exact = ClosestPointQuery(vertices, faces).query([point])
    near = NearestSurface(vertices, faces).query(np.array([point], float))
    assert_allclose(near.points, exact.points, atol=1e-12)


def test_query_facing_chooses_the_sheet_that_looks_the_right_way():
    sheet, faces = grid(8, 8)
    sheet = 10 * sheet
    both = np.concatenate([sheet, sheet + [0, 0, 0.1]])
    index = np.concatenate([faces, faces[:, ::-1] + len(sheet)])
    up = vertex_normals(sheet, faces)[0]
    point = np.array([[5.0, 5.0, 0.09]])
    query = ClosestPointQuery(both, index)
    assert query.query(point).distance[0] == pytest.approx(0.01)
    hit = query.query_facing(point, up[None])
    assert hit.distance[0] == pytest.approx(0.09)
    assert hit.points[0] == pytest.approx([5, 5, 0])


def test_triangles_without_area_or_with_coincident_corners_have_closest_points_too():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [1, 0, 0], [0, 0, 0], [0, 0, 0], [2, 0, 0]])
    faces = np.array([[0, 1, 2], [0, 3, 4], [3, 1, 5]])
    points = np.array([[0.0, 0, 0], [0.5, 1, 0], [1, 0, 0], [0, 0, 2], [3, 0, 1], [1.8, 1, 0]])
    hits = NearestSurface(vertices, faces).query(points)
    assert np.isfinite(hits.points).all()
    assert hits.distance[-1] == pytest.approx(1)
    assert_allclose(hits.barycentric.sum(1), 1)
    for corners in vertices[faces]:
        for order in ([0, 1, 2], [1, 2, 0], [2, 0, 1], [0, 2, 1]):
            for point in (points[1], corners[0]):
                weights = weights_nearest_origin(*(corners[order] - point))
                assert sum(weights) == pytest.approx(1)


def libigl_distance(vertices, faces, points):
    tree = igl.AABB()
    tree.init(vertices, faces)
    squared, _, _ = tree.squared_distance(vertices, faces, points)
    return np.sqrt(squared)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e6])
@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_the_exact_query_agrees_with_libigl_in_any_unit_and_place(scale, offset):
    rng = np.random.default_rng(3)
    points = scale * np.concatenate([rng.uniform(-5, 15, (300, 3)), VERTICES[FACES].mean(1)]) + offset
    vertices = scale * VERTICES + offset
    hits = ClosestPointQuery(vertices, FACES).query(points)
    tolerance = 1e-9 * (scale + offset)
    assert_allclose(hits.distance, libigl_distance(vertices, FACES, points), atol=tolerance)
    assert_allclose(np.linalg.norm(points - hits.points, axis=1), hits.distance, rtol=1e-6, atol=tolerance)


def test_thousands_of_coincident_triangles_and_slivers_are_searched_as_any():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1e6, 1e-6, 0], [5, 5, 5]])
    faces = np.concatenate([np.tile([0, 1, 2], (5000, 1)), [[0, 1, 3], [4, 4, 4]]])
    points = np.array([[0.2, 0.2, 1.0], [9e5, 0, 2], [5, 5, 6], [-1, 0, 0]])
    hits = ClosestPointQuery(vertices, faces).query(points)
    assert_allclose(hits.distance, [1, 2, 1, 1], atol=1e-5)
    assert hits.face[2] == 5001
    assert np.isfinite(hits.barycentric).all()


def test_no_points_have_no_answers():
    assert ClosestPointQuery(*grid(4, 4)).query(np.empty((0, 3))).distance.shape == (0,)
