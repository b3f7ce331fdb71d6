import numpy as np
import pytest
from helpers.meshes import grid, sphere
from hypothesis import given, settings, strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.geometry.loop_subdivision import LoopSubdivision, SurfacePoints, limit_matrix, refine

_, FACES = grid(7, 7)
"""Of a lattice in which every inner vertex has six neighbours."""


def row(matrix, index):
    line = matrix.tocsr()[index].tocoo()
    return {int(c): float(w) for c, w in zip(line.col, line.data, strict=True) if abs(w) > 1e-15}


CENTRE = 24  # of the 7 x 7 lattice
RING = {23, 25, 17, 31, 16, 32}


@pytest.mark.parametrize("levels", [0, 1, 2])
def test_rows_sum_to_one(levels):
    subdivision = LoopSubdivision.of(49, FACES, levels)
    assert_allclose(subdivision.matrix.sum(1), 1, atol=1e-14)
    assert len(subdivision.faces) == len(FACES) * 4**levels
    assert_array_equal(np.bincount(subdivision.parent), 4**levels)


def test_regular_limit_stencil_is_half_and_twelfths():
    weights = row(limit_matrix(49, FACES), CENTRE)
    assert weights.pop(CENTRE) == pytest.approx(1 / 2)
    assert weights == pytest.approx(dict.fromkeys(RING, 1 / 12))


def test_regular_refinement_stencils():
    matrix, _ = refine(49, FACES)
    weights = row(matrix, CENTRE)
    assert weights.pop(CENTRE) == pytest.approx(5 / 8)
    assert weights == pytest.approx(dict.fromkeys(RING, 1 / 16))
    edges = [row(matrix, r) for r in range(49, matrix.shape[0])]
    assert {CENTRE: 3 / 8, 25: 3 / 8, 17: 1 / 8, 32: 1 / 8} in edges


def test_boundary_follows_the_cubic_spline_of_the_boundary_alone():
    matrix, _ = refine(49, FACES)
    assert row(matrix, 3) == pytest.approx({2: 1 / 8, 3: 3 / 4, 4: 1 / 8})
    assert {2: 1 / 2, 3: 1 / 2} in [row(matrix, r) for r in range(49, matrix.shape[0])]
    assert row(limit_matrix(49, FACES), 3) == pytest.approx({2: 1 / 6, 3: 2 / 3, 4: 1 / 6})


def test_limit_does_not_move_under_refinement():
    vertices, faces = sphere(0, 1.0)
    coarse = LoopSubdivision.of(12, faces, 0).matrix @ vertices
    for levels in (1, 2, 3):
        fine = LoopSubdivision.of(12, faces, levels).matrix @ vertices
        assert_allclose(fine[:12], coarse, atol=1e-13)


def test_valence_five_keeps_the_icosahedrons_symmetry():
    vertices, faces = sphere(0, 1.0)
    # Closed form: ring average of the icosahedron lies at 1 / sqrt(5) of the vertex.
    n_beta = 0.625 - (0.375 + 0.25 * np.cos(2 * np.pi / 5)) ** 2
    share = 5 / (0.375 * 5 / n_beta + 5)
    limit = LoopSubdivision.of(12, faces, 0).matrix @ vertices
    assert_allclose(limit, (1 - share + share / np.sqrt(5)) * vertices, atol=1e-13)


def test_children_lie_in_their_parents():
    _, children = refine(49, FACES)
    for parent in (0, 17):
        corners = children[4 * parent : 4 * parent + 3]
        assert_array_equal(corners[np.arange(3), np.arange(3)], FACES[parent])
        middle = set(children[4 * parent + 3].tolist())
        assert middle == {int(v) for c in corners for v in c} - set(FACES[parent].tolist())


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 4607), st.floats(0, 1), st.floats(0, 1)), min_size=1, max_size=20),
    st.integers(0, 3),
)
def test_points_matrix_sums_to_one_and_control_points_undo_the_descent(rows, levels):
    subdivision = LoopSubdivision.of(49, FACES, levels)
    faces = np.array([row[0] for row in rows]) % len(subdivision.faces)
    u = np.array([[min(a, b), abs(a - b), 1 - max(a, b)] for _, a, b in rows])
    control = subdivision.control_points(SurfacePoints(faces, u))
    assert_array_equal(control.face, subdivision.parent[faces])
    assert_allclose(control.barycentric.sum(1), 1, atol=1e-12)
    matrix = subdivision.points_matrix(control)
    assert_allclose(matrix.sum(1), 1, atol=1e-12)
    vertices = np.random.default_rng(0).normal(size=(49, 3))
    direct = np.einsum("nk,nkj->nj", u, (subdivision.matrix @ vertices)[subdivision.faces[faces]])
    assert_allclose(matrix @ vertices, direct, atol=1e-11)


def test_unreferenced_vertices_stay():
    assert row(LoopSubdivision.of(50, FACES, 1).matrix, 49) == {49: 1}
