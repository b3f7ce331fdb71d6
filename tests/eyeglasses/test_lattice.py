import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.eyeglasses.lattice import (
    Lattice,
    biharmonic_energy,
    enclosed_cells,
    join_parts,
    lattice_laplacian,
    node_volumes,
    surface_cells,
    unique_cells,
)


def block(*shape):
    """All cells (C, 3) of a block, from 0 on."""
    return np.indices(shape).reshape(3, -1).T


def clipped(triangle, cell):
    """Return the polygon of a triangle inside a cube (Sutherland and Hodgman)."""
    polygon = list(triangle)
    for axis in range(3):
        for sign, bound in ((1, cell[axis]), (-1, -cell[axis] - 1)):
            kept = []
            for a, b in zip(polygon, polygon[1:] + polygon[:1], strict=True):
                here, there = sign * a[axis] - bound, sign * b[axis] - bound
                if here >= 0:
                    kept.append(a)
                if here * there < 0:
                    kept.append(a + (b - a) * here / (here - there))
            polygon = kept
    return polygon


@pytest.mark.parametrize("seed", range(12))
def test_surface_cells_are_those_that_clipping_finds(seed):
    rng = np.random.default_rng(seed)
    triangle = rng.uniform(-4, 4, (3, 3)) * ([1, 1, 0.05] if seed % 3 == 0 else [1, 1, 1])
    wanted = [cell for cell in block(10, 10, 10) - 5 if clipped(triangle, cell)]
    assert_array_equal(surface_cells(triangle[None], 10_000), wanted)


def test_triangles_without_area_leave_the_cells_of_their_corners_and_too_many_cells_end_the_search():
    corners = np.array([[0, 0, 0], [3, 0, 0], [7, 0, 0]])
    assert_array_equal(surface_cells(corners[None] + 0.5, 100), corners)
    assert surface_cells(1e6 * np.eye(3)[None], 1000) is None


def test_enclosed_cells_need_closed_walls():
    cells = block(5, 5, 5)
    inner = (np.abs(cells - 2) < 2).all(1)
    assert_array_equal(enclosed_cells(cells[~inner]), cells[inner])
    door = (cells == [0, 2, 2]).all(1)
    assert len(enclosed_cells(cells[~inner & ~door])) == 0


@pytest.fixture
def lattice():
    cells = block(6, 5, 4) - 2
    return Lattice.of_cells(cells[(cells[:, 0] < 1) | (cells[:, 1] < 0)])


def test_laplacian_is_symmetric_an_m_matrix_of_seven_points_and_biharmonic_energy_is_of_its_square(lattice):
    laplacian = lattice_laplacian(lattice)
    assert abs(laplacian - laplacian.T).max() == 0
    assert (laplacian - np.diag(laplacian.diagonal())).max() <= 0
    assert_allclose(laplacian @ np.ones(len(lattice.nodes)), 0, atol=1e-14)
    for axis in range(3):  # the integral of |grad x|^2
        x = lattice.nodes[:, axis]
        assert x @ (laplacian @ x) == pytest.approx(len(lattice.cells))
    volumes = node_volumes(lattice)
    assert volumes.sum() == pytest.approx(len(lattice.cells))
    inside = np.argmax(volumes == 1)
    assert sorted(laplacian[inside].data) == [-1] * 6 + [6]
    u = np.random.default_rng(0).random(len(lattice.nodes))
    expected = np.sum((laplacian @ u) ** 2 / volumes)
    assert u @ (biharmonic_energy(lattice) @ u) == pytest.approx(expected)


def test_interpolation_is_exact_for_linear_fields_and_convex(lattice):
    rng = np.random.default_rng(0)
    points = rng.choice(lattice.cells, 50) + rng.random((50, 3))
    matrix = lattice.interpolation(points)
    assert_allclose(matrix @ lattice.nodes, points, atol=1e-12)
    assert matrix.min() >= 0
    assert_allclose(matrix.sum(1), 1, atol=1e-15)
    # Points outside take the nearest place.
    outside = lattice.interpolation(np.array([[-7.0, -1.5, -1.25]]))
    assert_allclose(outside @ lattice.nodes, [[-2, -1.5, -1.25]])


def test_parts_in_reach_are_joined_and_others_left():
    cells = unique_cells(np.array([[0, 0, 0], [0, 0, 1], [5, 2, 0], [9, 2, 0], [40, 0, 0]]))
    joined = Lattice.of_cells(join_parts(cells, 6.0))
    parts = joined.cell_components[joined.find(cells)]
    assert len(set(parts[:4])) == 1
    assert parts[4] not in parts[:4]
    assert_array_equal(join_parts(cells, 1.0), cells)
