from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from face_model_generator.layout import inside_polygon, mirrored_mesh
from face_model_generator.meshing import MeshOptions, _with_curves, mesh_half

from scan2albedo.errors import ModelError
from scan2albedo.geometry.parametrization import boundary_loop, signed_areas

HALF_DISC = {
    "axis": np.array([[0, -10], [0, -4], [0, 3], [0, 10.0]]),
    "rim": np.array([[10 * np.cos(t), 10 * np.sin(t)] for t in np.linspace(-np.pi / 2, np.pi / 2, 13)]),
    "slit": np.array([[0, 3], [3, 3.5], [6, 3.0]]),
}
HALF_DISC["rim"][[0, -1]] = HALF_DISC["axis"][[0, -1]]


@pytest.fixture(scope="module")
def half():
    options = MeshOptions({"slit": 0.7}, coarse_edge_mm=2.5, growth=0.3, iterations=80)
    return mesh_half(HALF_DISC, ("axis", "rim"), options)


def test_mesh_is_a_disc_of_the_right_area(half):
    boundary_loop(len(half.flat), half.faces)
    areas = signed_areas(half.flat, half.faces)
    assert areas.min() > 0
    assert areas.sum() == pytest.approx(np.pi * 50, rel=0.03)


def test_mesh_follows_its_curves(half):
    edges = {tuple(sorted(e)) for f in half.faces.tolist() for e in (f[:2], f[1:], f[::2])}
    for index in half.curves.values():
        assert all(tuple(sorted(pair)) in edges for pair in pairwise(index))
    np.testing.assert_allclose(half.flat[half.curves["slit"][0]], [0, 3], atol=1e-6)
    np.testing.assert_allclose(half.flat[half.curves["axis"], 0], 0, atol=1e-9)


def test_mesh_is_finer_at_the_slit(half):
    areas = signed_areas(half.flat, half.faces)
    near = np.linalg.norm(half.flat[half.faces].mean(1) - [3, 3.3], axis=1) < 1.5
    far = half.flat[half.faces].mean(1)[:, 1] < -4
    assert areas[far].mean() > 4 * areas[near].mean()


def test_a_crossing_edge_is_flipped():
    square = np.array([[0, 1, 2], [0, 2, 3]])
    flipped = _with_curves(square, {"diagonal": np.array([1, 3])})
    assert {frozenset(f) for f in flipped.tolist()} == {frozenset({0, 1, 3}), frozenset({1, 2, 3})}
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    assert signed_areas(corners, flipped).min() > 0
    assert signed_areas(corners, square).min() > 0
    with pytest.raises(ModelError, match="cannot follow the curve far"):
        _with_curves(np.array([[0, 1, 2], [2, 1, 3], [2, 3, 4]]), {"far": np.array([0, 4])})


def test_mirrored_mesh_joins_at_the_middle(half):
    middle = np.abs(half.flat[:, 0]) < 1e-9
    whole, faces, mirror = mirrored_mesh(half.flat, half.faces, middle)
    assert len(whole) == 2 * len(half.flat) - middle.sum()
    boundary_loop(len(whole), faces)
    np.testing.assert_allclose(whole[mirror], whole * [-1, 1], atol=1e-12)
    assert signed_areas(whole, faces).min() > 0


def test_inside_polygon_of_a_concave_shape():
    polygon = np.array([[0, 0], [4, 0], [4, 4], [2, 1], [0, 4.0]])
    points = np.array([[1, 1], [2, 2], [3.5, 2], [5, 1], [2, 0.5], [-1, 0.5]])
    np.testing.assert_array_equal(inside_polygon(points, polygon), [True, False, True, False, True, False])
