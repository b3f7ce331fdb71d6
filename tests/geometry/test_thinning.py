import numpy as np
import pytest
import trimesh
from helpers.face_mask import mask_surface

from scan2albedo.geometry.mesh import boundary_vertex_mask, thinned, vertex_normals


def test_a_coarse_surface_stays_as_it_is():
    vertices, faces = mask_surface(20)
    thin = thinned(vertices, faces, 1.0)
    assert len(thin.vertices) == len(vertices)
    assert thin.faces.shape == faces.shape
    assert (thin.count == 1).all()
    assert thin.boundary.sum() == boundary_vertex_mask(len(vertices), faces).sum()


def test_a_dense_surface_keeps_its_place_and_its_border():
    vertices, faces = mask_surface(200)
    thin = thinned(vertices, faces, 4.0)
    assert thin.count.sum() == len(vertices)
    assert len(thin.vertices) < len(vertices) / 5
    flat, even = thin.vertices[:, :2], vertices[:, :2]
    away = np.maximum(np.abs(even).max(0) - np.abs(flat), 0).min(1)
    assert away[thin.boundary].max() < 4.0
    assert not thin.boundary[away > 4.0].any()
    assert (vertex_normals(thin.vertices, thin.faces)[:, 2] > 0).mean() > 0.98


def test_a_cell_of_many_vertices_averages_their_noise_out():
    vertices, faces = mask_surface(300)
    plane = vertices * [1, 1, 0]
    noise = np.random.default_rng(0).normal(size=len(plane))
    thin = thinned(plane + noise[:, None] * [0, 0, 0.1], faces, 4.0)
    full = thin.count > 15
    assert full.mean() > 0.5
    assert thin.vertices[full, 2].std() < 0.1 / np.sqrt(12)


@pytest.mark.parametrize("cell_mm", [1e-3, 0.5, 5.0])
def test_seams_close_and_a_closed_surface_has_no_border_however_it_crumples(cell_mm):
    torus = trimesh.creation.torus(40.0, 15.0, major_sections=120, minor_sections=50)
    faces = np.asarray(torus.faces)
    crumpled = torus.vertices + np.random.default_rng(1).normal(scale=0.5, size=torus.vertices.shape)
    soup, separate = crumpled[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3)
    assert boundary_vertex_mask(len(soup), separate).all()
    assert not thinned(soup, separate, cell_mm).boundary.any()


def test_a_surface_within_one_cell_has_no_faces_left():
    vertices, faces = mask_surface(5)
    thin = thinned(vertices * 1e-3, faces, 5.0)
    assert len(thin.vertices) == 1
    assert thin.faces.shape == (0, 3)


def test_a_vertex_far_away_joins_only_its_neighbours():
    vertices = np.array([[0.0, 0, 0], [1e20, 0, 0], [0, 1e20, 0], [0, 1e20, 1.0]])
    thin = thinned(vertices, np.array([[0, 1, 2], [0, 1, 3]]), 2.0)
    np.testing.assert_array_equal(np.sort(thin.count), [1, 1, 2])
    np.testing.assert_allclose(np.sort(thin.vertices[:, 0]), [0, 0, 1e20])
