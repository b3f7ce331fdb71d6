"""Elementary mesh quantities against closed forms."""

import numpy as np
import trimesh

from scan2albedo.geometry import mesh


def test_area_and_normals_of_a_sphere():
    sphere = trimesh.creation.icosphere(4, 10.0)
    vertices, faces = np.asarray(sphere.vertices), np.asarray(sphere.faces)
    assert abs(mesh.face_areas(vertices, faces).sum() - 400 * np.pi) < 0.01 * 400 * np.pi
    np.testing.assert_allclose(
        mesh.vertex_areas(vertices, faces).sum(), mesh.face_areas(vertices, faces).sum()
    )
    outward = np.einsum("ij,ij->i", mesh.vertex_normals(vertices, faces), vertices / 10)
    assert outward.min() > 0.999


def test_zero_area_faces_and_lone_vertices_have_zero_normals_not_nan():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [9, 9, 9]])
    faces = np.array([[0, 1, 2]])
    assert (mesh.face_normals(vertices, faces) == 0).all()
    assert (mesh.vertex_normals(vertices, faces) == 0).all()


def test_boundary_of_an_open_square_and_of_a_closed_box():
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    assert len(mesh.boundary_edges(faces)) == 4
    assert mesh.boundary_vertex_mask(5, faces).tolist() == [True, True, True, True, False]
    assert len(mesh.boundary_edges(np.asarray(trimesh.creation.box().faces))) == 0


def test_components_and_unreferenced_vertices():
    faces = np.array([[0, 1, 2], [4, 5, 6]])
    labels = mesh.vertex_components(8, faces)
    assert labels[0] == labels[1] == labels[2] != labels[4]
    assert len(set(labels.tolist())) == 4
    kept, renumbered = mesh.without_unreferenced(np.zeros((8, 3)), faces)
    assert kept.tolist() == [0, 1, 2, 4, 5, 6]
    assert renumbered.tolist() == [[0, 1, 2], [3, 4, 5]]
