"""Holes of a template are closed."""

import numpy as np
import pytest
from helpers.meshes import grid

from scan2albedo.geometry.mesh import (
    boundary_loops,
    boundary_vertex_mask,
    edges_with_faces,
    face_areas,
    face_cross_products,
)
from scan2albedo.templates.surface import fill_hole


def test_a_hole_is_closed_with_least_area_and_the_right_orientation():
    vertices, faces = grid(9, 9)
    centre = vertices[faces].mean(1)
    open_mesh = faces[np.linalg.norm(centre - [0.5, 0.5, 0], axis=1) > 0.25]
    rim, hole = boundary_loops(open_mesh)
    assert len(rim) == 32
    closed = np.concatenate([open_mesh, fill_hole(vertices, open_mesh, hole)])
    assert boundary_vertex_mask(len(vertices), closed).sum() == len(rim)
    assert face_areas(vertices, closed).sum() == pytest.approx(1)
    assert (face_cross_products(vertices, closed)[:, 2] >= -1e-15).all()


def test_a_chord_that_is_an_edge_of_the_mesh_already_is_not_used_again():
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 5.0]])
    behind = np.array([[0, 4, 2]])  # holds the edge 0-2, the diagonal that least area might take
    for loop in (np.array([0, 1, 2, 3]), np.array([1, 2, 3, 0])):
        patch = fill_hole(square, behind, loop)
        used = edges_with_faces(patch)[0].tolist()
        assert [1, 3] in used
        assert [0, 2] not in used
