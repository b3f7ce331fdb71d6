"""Light between parts of a face: form factors against closed forms, and fits that take it for what it is."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.meshes import grid, sphere
from scipy.sparse import csr_array

from scan2albedo.errors import ReflectanceError
from scan2albedo.geometry.mesh import vertex_areas, vertex_normals
from scan2albedo.reflectance import (
    VertexSamples,
    fit_reflectance,
    lobe_slopes,
    point_light_lobes,
    relighting_error,
)
from scan2albedo.reflectance.vertex_visibility import VertexVisibility

ALBEDO = np.array([0.7, 0.5, 0.2])


def factors_of(vertices, faces):
    return VertexVisibility(vertices, faces, vertex_normals(vertices, faces)).form_factors()


def test_inside_of_a_ball_sees_itself_all_around_and_outside_not_at_all():
    vertices, faces = sphere(3)
    inside = factors_of(vertices, faces[:, ::-1])
    assert np.asarray(inside.sum(1)).ravel() == pytest.approx(1, abs=0.03)
    assert factors_of(vertices, faces).nnz == 0


@pytest.fixture(scope="module")
def dug():
    """Samples of a groove of 90 degrees, what it bounces by small areas, and vertices off edges."""
    square, faces = grid(23, 13)
    x, y = ((square[:, :2] - 0.5) * [100, 120]).T
    vertices = np.stack([x, y, np.abs(x)], 1)
    normals = vertex_normals(vertices, faces)
    rng = np.random.default_rng(0)
    cameras, lights = (np.column_stack([rng.uniform(-250, 250, (12, 2)), np.full(12, z)]) for z in (700, 800))
    lobes = point_light_lobes(vertices, normals, cameras, lights)
    slopes = lobe_slopes(vertices, normals, cameras, lights)
    # The areas around vertices send light to all others.
    area = vertex_areas(vertices, faces)
    way = vertices[None] - vertices[:, None]
    cosine = np.maximum(np.einsum("vwc,vc->vw", way, normals), 0)
    kernel = cosine * cosine.T * area / (np.pi * np.maximum(np.linalg.norm(way, axis=2), 1e-9) ** 4)
    light = lobes[..., :1] + np.zeros(3)
    leaving = [np.linalg.solve(np.eye(len(area)) - one * kernel, one * lobes[..., 0].T) for one in ALBEDO]
    sent = (kernel @ leaving).T
    gloss = 0.05 * lobes[..., 1:].sum(-1, keepdims=True)
    sigma = np.full(light.shape, 0.002)
    observed = ALBEDO * (light + sent) + gloss + sigma * rng.standard_normal(light.shape)
    samples = VertexSamples(
        *(observed, sigma, np.ones(light.shape, bool), lobes, np.arange(12), slopes),
        form_factors=factors_of(vertices, faces),
    )
    inner = (np.abs(x) > 8) & (np.abs(x) < 48) & (np.abs(y) < 55)
    return samples, sent, inner


def test_bounced_light_agrees_with_a_sum_over_areas(dug):
    samples, sent, inner = dug
    found = samples.bounced_light(ALBEDO)
    assert found[:, inner] == pytest.approx(sent[:, inner], rel=0.25)
    assert found[:, inner].sum((0, 1)) == pytest.approx(sent[:, inner].sum((0, 1)), rel=0.05)


def test_light_of_the_other_side_is_not_taken_for_albedo(dug):
    samples, _, inner = dug
    without = replace(samples, form_factors=None)
    plain, fit = fit_reflectance(without), fit_reflectance(samples)
    off, held = [], []
    for one in (plain, fit):
        off.append(np.median(np.abs(one.reflectance.diffuse_linear[inner] / ALBEDO - 1), axis=0)[0])
        inside = (one.low[:, :3] <= ALBEDO) & (one.high[:, :3] >= ALBEDO)
        held.append(inside[inner].mean(0).min())
    assert off[1] < 0.6 * off[0]
    assert held[0] < 0.7 < 0.9 < held[1]
    assert fit.plan.ran("reflectance.bounce")
    assert "red" in fit.plan[0].evidence
    assert not plain.plan.ran("reflectance.bounce")
    assert not plain.bounce_albedo.any()
    held_out = np.arange(len(samples.light)) % 4 == 1
    errors = [relighting_error(one, held_out).relative_rmse for one in (samples, without)]
    assert errors[0] < errors[1]


def test_captures_without_bounced_light_are_nearly_as_they_were(dug):
    samples, sent, inner = dug
    direct = replace(samples, observed_linear=samples.observed_linear - ALBEDO * sent)
    plain, fit = fit_reflectance(replace(direct, form_factors=None)), fit_reflectance(direct)
    assert fit.bounce_albedo.max() < 0.15 * ALBEDO.max()
    moved = np.abs(fit.reflectance.diffuse_linear - plain.reflectance.diffuse_linear)[inner]
    assert np.median(moved / ALBEDO) < 0.02


def test_a_convex_mesh_costs_nothing(dug):
    samples = replace(dug[0], form_factors=csr_array(dug[0].form_factors.shape))
    plain, fit = fit_reflectance(replace(samples, form_factors=None)), fit_reflectance(samples)
    assert np.array_equal(plain.low, fit.low, equal_nan=True)
    assert "no part" in fit.plan[0].reason


def test_other_shapes_are_refused(dug):
    with pytest.raises(ReflectanceError, match="form_factors is"):
        replace(dug[0], form_factors=dug[0].form_factors[:-1])
