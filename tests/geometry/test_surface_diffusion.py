"""Diffusion over a mesh: the distance is in millimetres, and nothing is lost or made."""

import igl
import numpy as np
import pytest

from scan2albedo.geometry.mesh import vertex_areas
from scan2albedo.geometry.surface_diffusion import surface_diffusion


def sheet(count, side_mm=100.0):
    vertices, faces = igl.triangulated_grid(count, count)
    return np.column_stack([side_mm * (vertices - 0.5), np.zeros(len(vertices))]), np.asarray(faces, np.int64)


def spread_of_a_peak(count, deviation_mm):
    vertices, faces = sheet(count)
    peak = np.zeros(len(vertices))
    peak[np.linalg.norm(vertices, axis=1).argmin()] = 1.0
    bump = surface_diffusion(vertices, faces, deviation_mm)(peak) * vertex_areas(vertices, faces)
    return np.sqrt(bump @ vertices[:, 0] ** 2 / bump.sum())


@pytest.mark.parametrize("count", [41, 81])
def test_a_peak_spreads_over_the_distance_asked_for_whatever_the_resolution(count):
    assert spread_of_a_peak(count, 6.0) == pytest.approx(6.0, rel=0.05)


def test_the_integral_and_the_range_stay():
    vertices, faces = sheet(21)
    vertices[:, 2] = 10 * np.sin(vertices[:, 0] / 9)
    values = np.random.default_rng(0).uniform(2, 3, (len(vertices), 2))
    smooth = surface_diffusion(vertices, faces, 8.0)(values)
    area = vertex_areas(vertices, faces)
    np.testing.assert_allclose(area @ smooth, area @ values)
    assert smooth.min() >= 2
    assert smooth.max() <= 3
    assert smooth.std() < 0.5 * values.std()


def test_vertices_that_stand_alone_keep_what_they_have():
    vertices, faces = sheet(5)
    vertices = np.vstack([vertices, [[0, 0, 50.0]]])
    values = np.random.default_rng(0).normal(size=(26, 4, 2))
    smooth = surface_diffusion(vertices, faces, 20.0)(values)
    np.testing.assert_array_equal(smooth[-1], values[-1])
    np.testing.assert_array_equal(surface_diffusion(vertices, faces, 0.0)(values), values)


def test_slivers_and_long_distances_stay_finite():
    vertices, faces = sheet(5)
    vertices[7] = vertices[6] + [1e-9, 0, 0]
    smooth = surface_diffusion(vertices, faces, 1e5)(np.arange(25.0))
    assert np.isfinite(smooth).all()
    assert np.ptp(smooth) < 1e-3


def test_what_is_no_distance_or_not_a_value_a_vertex_is_refused():
    vertices, faces = sheet(5)
    for wrong in (-1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="deviation_mm"):
            surface_diffusion(vertices, faces, wrong)
    with pytest.raises(ValueError, match="values have shape"):
        surface_diffusion(vertices, faces, 1.0)(np.zeros(3))
