"""Energies, means, diffusion and fillings over meshes, and the derivative of vertex normals."""

import numpy as np
import pytest
from helpers.meshes import grid
from numpy.testing import assert_allclose

from scan2albedo.geometry.loop_subdivision import LoopSubdivision
from scan2albedo.geometry.mesh import face_areas, vertex_normals
from scan2albedo.geometry.operators import (
    bending,
    laplacian,
    linear_refinement,
    vertex_average,
    vertex_minimum,
    vertex_normal_jacobian,
)


def test_membrane_energy_of_a_linear_field_is_its_gradient_squared_times_area():
    vertices, faces = grid(9, 9)
    u = 3 * vertices[:, 0] - 2 * vertices[:, 1]
    assert u @ laplacian(vertices, faces) @ u == pytest.approx(9 + 4)
    assert u @ laplacian(vertices, faces, np.full(len(faces), 0.5)) @ u == pytest.approx(6.5)


def test_bending_energy_is_zero_on_linear_fields_and_close_to_the_integral_on_quadratic_ones():
    vertices, faces = grid(41, 41)
    flat = vertices[:, 0] + 2 * vertices[:, 1]
    plate = bending(vertices, faces)
    assert flat @ plate @ flat == pytest.approx(0, abs=1e-6)
    bowl = vertices[:, 0] ** 2 + vertices[:, 1] ** 2
    assert bowl @ plate @ bowl == pytest.approx(16, rel=0.1)


def test_operators_are_positive_semi_definite_even_on_slivers():
    rng = np.random.default_rng(3)
    vertices, faces = grid(5, 5)
    vertices[:, 1] *= 1e-7
    vertices[3] = vertices[4]
    for matrix in (laplacian(vertices, faces), bending(vertices, faces)):
        dense = matrix.toarray()
        assert_allclose(dense, dense.T, atol=1e-9 * np.abs(dense).max())
        u = rng.normal(size=(len(vertices), 10))
        assert (np.einsum("ij,ij->j", u, dense @ u) >= -1e-9 * np.abs(dense).max()).all()


def test_a_cut_of_zero_weight_lets_two_halves_move_apart():
    vertices, faces = grid(21, 21)
    middle = vertices[faces][:, :, 0].mean(1)
    cut = np.where(np.abs(middle - 0.5) < 0.06, 0.0, 1.0)
    halves = np.where(vertices[:, 0] > 0.5, 1.0, 0.0)
    for operator in (laplacian, bending):
        assert halves @ operator(vertices, faces) @ halves > 1
        assert halves @ operator(vertices, faces, cut) @ halves == pytest.approx(0, abs=1e-8)


def test_vertex_reductions():
    faces = np.array([[0, 1, 2], [2, 1, 3]])
    assert_allclose(vertex_average(5, faces, np.array([1.0, 3.0])), [1, 2, 2, 3, 0])
    assert_allclose(vertex_minimum(5, faces, np.array([1.0, 3.0])), [1, 1, 1, 3, 0])


def test_linear_refinement_numbers_vertices_as_subdivision_does():
    vertices, faces = grid(4, 4)
    subdivision = LoopSubdivision.of(len(vertices), faces, 2)
    fine = linear_refinement(len(vertices), faces, 2) @ vertices
    areas = face_areas(fine, subdivision.faces)
    assert_allclose(areas, areas[0])
    assert areas.sum() == pytest.approx(1)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e5])
def test_the_derivative_of_normals_agrees_with_finite_differences(model, scale):
    vertices, faces = model.surface(0)
    jacobian = vertex_normal_jacobian(scale * vertices, faces)
    for direction in np.random.default_rng(0).normal(size=(2, *vertices.shape)):
        ahead, behind = (vertex_normals(vertices + h * direction, faces) for h in (1e-6, -1e-6))
        expected = (ahead - behind).ravel() / (2e-6 * scale)
        assert_allclose(jacobian @ direction.ravel(), expected, atol=1e-7 * np.abs(expected).max())


def test_vertices_without_area_have_no_derivative():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5], [2, 0, 0], [3, 0, 0]])
    jacobian = vertex_normal_jacobian(vertices, np.array([[0, 1, 2], [1, 4, 5]])).toarray()
    assert np.isfinite(jacobian).all()
    assert (jacobian[9:] == 0).all()
    assert np.abs(jacobian[:9]).max() > 0
