"""Charts of discs, and how far charts are from isometries."""

import numpy as np
import pytest
from helpers.chart_distortion import chart_distortion
from helpers.meshes import grid
from numpy.testing import assert_allclose

from scan2albedo.errors import ModelError
from scan2albedo.geometry.loop_subdivision import refine
from scan2albedo.geometry.parametrization import (
    boundary_curve,
    boundary_loop,
    flatten_disc,
    parametrize_disc,
    signed_areas,
    tutte,
)


def test_distortion_of_known_maps():
    v, f = grid(3, 3)
    v = 2 * v - [1, 1, 0]
    stretched = chart_distortion(v, f, v[:, :2] * [-3.0, 1.0])
    assert_allclose([stretched.area, stretched.conformal, stretched.coverage], [0, 3, -12], atol=1e-12)
    assert stretched.flipped == len(f)


def symmetric_grid(n, m):
    """Return n x m vertices over [-1, 1]^2, faces mirror symmetric about x = 0, and the mirrored vertices."""
    vertices, faces = grid(n, m)
    mirror = np.arange(n * m).reshape(m, n)[:, ::-1].ravel()
    left = faces[vertices[faces, 0].mean(1) < 0.5]
    return vertices * 2 - [1, 1, 0], np.concatenate([left, mirror[left][:, ::-1]]), mirror


@pytest.fixture(scope="module")
def dome():
    v, f, mirror = symmetric_grid(15, 21)
    x, y = v[:, 0], 1.4 * v[:, 1]
    z = 1.2 - 1.3 * x**2 + 0.5 * np.exp(-10 * (x**2 + y**2))
    return np.stack([x, y, z], 1), f, mirror


def test_chart_of_a_dome_is_flip_free_symmetric_and_fills_the_square(dome):
    v, f, mirror = dome
    uv = parametrize_disc(v, f, mirror=mirror)
    quality = chart_distortion(v, f, uv)
    assert quality.flipped == 0
    assert quality.coverage > 0.75
    assert quality.area < 0.25
    assert quality.conformal < 1.6
    assert_allclose(uv[mirror], uv * [-1, 1] + [1, 0], atol=1e-12)
    assert uv.min() >= 0
    assert uv.max() <= 1
    for _ in range(2):
        matrix, f = refine(len(uv), f)
        uv = matrix @ uv
    assert signed_areas(uv, f).min() > 0


def test_a_chart_has_about_unit_area_before_packing(dome):
    vertices, faces, mirror = dome
    assert signed_areas(flatten_disc(vertices, faces, mirror), faces).sum() == pytest.approx(1, abs=0.01)


def test_chart_turns_with_the_axes_whatever_the_unit_and_is_less_distorted_than_tuttes(dome):
    v, f, _ = dome
    uv = parametrize_disc(v, f)
    assert np.corrcoef(uv.T, v[:, :2].T)[[0, 1], [2, 3]].min() > 0.95
    assert_allclose(uv, parametrize_disc(v * 1e3 + 1e4, f), atol=1e-5)
    loop = boundary_loop(len(v), f)
    plain = chart_distortion(v, f, tutte(len(v), f, loop, boundary_curve(v, loop)))
    assert chart_distortion(v, f, uv).area < plain.area


def test_tutte_puts_inner_vertices_at_the_mean_of_their_neighbours():
    v, f, _ = symmetric_grid(5, 5)
    loop = boundary_loop(len(v), f)
    uv = tutte(len(v), f, loop, v[loop, :2] ** 3)
    centre = 12
    ring = np.setdiff1d(np.unique(f[(f == centre).any(1)]), [centre])
    assert_allclose(uv[centre], uv[ring].mean(0), atol=1e-12)


def test_no_disc_is_refused_with_the_reason():
    v, f, _ = symmetric_grid(5, 5)
    tetrahedron = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
    for vertices, faces, reason in (
        (v, f[~(f == 12).any(1)], r"not a disc.*Euler characteristic 0"),
        (np.concatenate([v, v + 5]), np.concatenate([f, f + len(v)]), "2 components"),
        (np.eye(4)[:, :3], tetrahedron, "not a disc"),
        (np.concatenate([v, [[9.0, 9, 9]]]), f, "1 of 26 vertices are in no face"),
    ):
        with pytest.raises(ModelError, match=reason):
            parametrize_disc(vertices, faces)
