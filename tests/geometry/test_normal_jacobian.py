"""How normals turn with vertices: finite differences, invariances, degenerate meshes."""

import numpy as np
import pytest

from scan2albedo import AnnotatedFaceModel
from scan2albedo.geometry.mesh import vertex_normals
from scan2albedo.geometry.normal_jacobian import cross_matrices, vertex_normal_jacobian

VERTICES, FACES = AnnotatedFaceModel.default().surface(0)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e5])
def test_it_agrees_with_finite_differences(scale):
    vertices, step = scale * VERTICES, 1e-6 * scale
    jacobian = vertex_normal_jacobian(vertices, FACES)
    for direction in np.random.default_rng(0).normal(size=(2, *vertices.shape)):
        ahead, behind = (vertex_normals(vertices + h * direction, FACES) for h in (step, -step))
        expected = (ahead - behind) / (2 * step)
        found = (jacobian @ direction.ravel()).reshape(-1, 3)
        np.testing.assert_allclose(found, expected, atol=1e-7 * np.abs(expected).max())


def test_shifts_and_scale_turn_nothing_and_turns_turn_alike():
    jacobian = vertex_normal_jacobian(VERTICES, FACES)
    np.testing.assert_allclose(jacobian @ np.tile([1.0, 2, 3], len(VERTICES)), 0, atol=1e-12)
    np.testing.assert_allclose(jacobian @ VERTICES.ravel(), 0, atol=1e-11)
    axis = np.array([0.3, -0.2, 0.5])
    turned = (jacobian @ np.cross(axis, VERTICES).ravel()).reshape(-1, 3)
    np.testing.assert_allclose(turned, np.cross(axis, vertex_normals(VERTICES, FACES)), atol=1e-11)


def test_vertices_without_area_have_no_derivative():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5], [2, 0, 0], [3, 0, 0]])
    jacobian = vertex_normal_jacobian(vertices, np.array([[0, 1, 2], [1, 4, 5]])).toarray()
    assert np.isfinite(jacobian).all()
    assert (jacobian[9:] == 0).all()
    assert np.abs(jacobian[:9]).max() > 0


def test_cross_matrices_are_cross_products():
    a, b = np.random.default_rng(0).normal(size=(2, 5, 3))
    np.testing.assert_allclose(np.einsum("nij,nj->ni", cross_matrices(a), b), np.cross(a, b))
