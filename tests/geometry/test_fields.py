"""Fields go on from what is known as the closed forms say, on grids and on meshes."""

import numpy as np
import pytest
from helpers.meshes import grid
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.geometry.fields import (
    Field,
    factorized,
    filled_over_grid,
    filled_over_mesh,
    grid_links,
    surface_diffusion,
)
from scan2albedo.geometry.mesh import edges_with_faces, vertex_areas

RNG = np.random.default_rng(0)
WAVES = RNG.random((40, 50, 3))
GAPS = np.hypot(*(np.indices((40, 50)) - [[[18]], [[24]]])) < 12


def test_a_ramp_rises_evenly_between_two_ends():
    """Along a chain, over a grid and over a mesh, in several channels as in each alone."""
    ramp = np.linspace(0, 1, 50)
    ends = np.isin(ramp, [0, 1])
    assert_allclose(Field(grid_links(ends[None] | True), ~ends).solve(ends * ramp), ramp, atol=1e-6)
    image = np.broadcast_to(ramp, (8, 50))
    gaps = np.tile(~ends, (8, 1))
    filled = filled_over_grid(np.where(gaps, 9.0, image), gaps, ~gaps)
    assert_allclose(filled, image, atol=1e-5)
    _, faces = grid(9, 9)
    row, column = np.divmod(np.arange(81), 9)
    values = np.stack([2.0 * row - column, 0.5 * column], 1)
    hole = (abs(row - 4) < 3) & (abs(column - 4) < 3)
    broken = np.where(hole[:, None], np.nan, values)
    together = filled_over_mesh(broken, ~hole, faces)
    assert_allclose(together, values, atol=1e-7)
    assert_allclose(filled_over_mesh(broken[:, 1:], ~hole, faces), together[:, 1:], atol=1e-12)


@pytest.mark.parametrize(("weight", "pull"), [(1.0, 0.01), (4.0, 0.5)])
def test_a_screened_field_decays_exponentially_to_what_it_is_pulled_to(weight, pull):
    """On a chain u_(n+1) - (2 + p / w) u_n + u_(n-1) = 0, so u falls by the root below 1 at each link."""
    count = 400
    links = grid_links(np.ones((1, count), bool))
    field = Field(links, np.arange(count) > 0, weight=weight, pull=np.full(count, pull))
    found = field.solve(np.where(np.arange(count) == 0, 7.0, 2.0))
    half = 1 + pull / weight / 2
    rate = half - np.sqrt(half**2 - 1)
    assert_allclose(found, 2 + 5 * rate ** np.arange(count), atol=1e-9)


def test_a_soft_value_and_a_hard_one_meet_by_their_weights():
    """Of springs in a row the change is shared as their softness: 1 / w of the link, 1 / p of the pull."""
    field = Field(np.array([[0, 1]]), np.array([False, True]), weight=3.0, pull=1.0)
    assert_allclose(field.solve(np.array([0.0, 8.0])), [0, 2])


def test_gradients_integrate_to_the_field_they_came_from():
    across, down = np.diff(WAVES, axis=1), np.diff(WAVES, axis=0)
    broken = np.where(GAPS[..., None], 7.0, WAVES)
    together = filled_over_grid(broken, GAPS, ~GAPS, across=across, down=down)
    assert_allclose(together, WAVES, atol=1e-5)
    alone = filled_over_grid(broken[..., 1], GAPS, ~GAPS, across=across[..., 1], down=down[..., 1])
    assert_allclose(together[..., 1], alone, atol=1e-9)
    # So do the steps along a mesh's edges.
    vertices, faces = grid(9, 9)
    links, height = edges_with_faces(faces)[0], vertices[:, 0] ** 2 - vertices[:, 1]
    free = np.arange(81) != 40
    field = Field(links, free, weight=RNG.uniform(1, 2, len(links)))
    assert_allclose(field.solve(height * ~free, np.diff(height[links])[:, 0]), height, atol=1e-6)


def test_what_touches_nothing_known_keeps_its_level():
    still = filled_over_grid(WAVES, GAPS, GAPS & ~GAPS)
    assert_allclose(still[GAPS], np.broadcast_to(WAVES[GAPS].mean(0), (GAPS.sum(), 3)), atol=1e-6)
    assert_array_equal(still[~GAPS], WAVES[~GAPS])
    across, down = np.diff(WAVES, axis=1), np.diff(WAVES, axis=0)
    kept = filled_over_grid(WAVES, GAPS, GAPS & ~GAPS, across=across, down=down)
    assert_allclose(kept, WAVES, atol=1e-12)
    one = np.zeros_like(GAPS)
    one[3, 3] = True
    assert_array_equal(filled_over_grid(WAVES, one, one & ~one), WAVES)
    assert_array_equal(filled_over_grid(WAVES, one & ~one, ~one), WAVES)
    # A part of a mesh without any known vertex gets the mean of all that is known.
    faces, values = np.arange(6).reshape(2, 3), np.array([1.0, 3, 9, 9, 9, 9])
    filled = filled_over_mesh(values[:, None], values < 9, faces)
    assert_allclose(filled.ravel(), [1, 3, 2, 2, 2, 2])
    with pytest.raises(ValueError, match="no vertex is known"):
        filled_over_mesh(values[:, None], values < 0, faces)


def test_a_pull_keeps_gradients_that_contradict_one_another_from_drifting():
    """Steps that are a little off add up along a strip with one known end, unless old values hold them."""
    gaps, old = np.arange(400)[None] > 0, np.ones((1, 400))
    across, down = np.full((1, 399), 0.01), np.zeros((0, 400))
    free, held = (
        filled_over_grid(old, gaps, ~gaps, across=across, down=down, pull=pull)[0, -1]
        for pull in (1e-9, 1e-3)
    )
    assert free == pytest.approx(1 + 3.99, abs=0.01)
    assert held < 1.6


def test_equations_without_one_solution_are_refused():
    with pytest.raises(RuntimeError, match="singular"):
        Field(np.array([[0, 1]]), np.ones(2, bool), pull=0.0)
    matrix = np.array([[2.0, -1], [-1, 2]])
    assert_allclose(
        factorized(matrix)(np.array([[1.0, 0], [1, 3]])), np.linalg.solve(matrix, [[1, 0], [1, 3]])
    )


def sheet(count):
    vertices, faces = grid(count, count)
    return 100 * (vertices - [0.5, 0.5, 0.0]), faces


@pytest.mark.parametrize("count", [41, 81])
def test_a_peak_spreads_over_the_distance_asked_for_whatever_the_resolution(count):
    vertices, faces = sheet(count)
    peak = (np.linalg.norm(vertices, axis=1) < 1e-9).astype(float)
    bump = surface_diffusion(vertices, faces, 6.0)(peak) * vertex_areas(vertices, faces)
    assert np.sqrt(bump @ vertices[:, 0] ** 2 / bump.sum()) == pytest.approx(6.0, rel=0.05)


def test_the_integral_and_the_range_stay():
    vertices, faces = sheet(21)
    vertices[:, 2] = 10 * np.sin(vertices[:, 0] / 9)
    values = np.random.default_rng(0).uniform(2, 3, (len(vertices), 2))
    smooth = surface_diffusion(vertices, faces, 8.0)(values)
    area = vertex_areas(vertices, faces)
    assert_allclose(area @ smooth, area @ values)
    assert smooth.min() >= 2
    assert smooth.max() <= 3
    assert smooth.std() < 0.5 * values.std()


def test_vertices_that_stand_alone_keep_what_they_have():
    vertices, faces = sheet(5)
    vertices = np.vstack([vertices, [[0, 0, 50.0]]])
    values = np.random.default_rng(0).normal(size=(26, 4, 2))
    smooth = surface_diffusion(vertices, faces, 20.0)(values)
    assert_array_equal(smooth[-1], values[-1])
    assert_array_equal(surface_diffusion(vertices, faces, 0.0)(values), values)


def test_slivers_and_long_distances_stay_finite():
    vertices, faces = sheet(5)
    vertices[7] = vertices[6] + [1e-9, 0, 0]
    smooth = surface_diffusion(vertices, faces, 1e5)(np.arange(25.0))
    assert np.ptp(smooth) < 1e-3


def test_what_is_no_distance_or_not_a_value_a_vertex_is_refused():
    vertices, faces = sheet(5)
    for wrong in (-1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="deviation_mm"):
            surface_diffusion(vertices, faces, wrong)
    with pytest.raises(ValueError, match="values have shape"):
        surface_diffusion(vertices, faces, 1.0)(np.zeros(3))
