"""Coefficients of a linear model: closed forms, and recovery from scans of the model's own shapes."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.measures import rms, row_lengths
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo import AnnotatedFaceModel, Budget, RawScan, fit
from scan2albedo.core import Meter
from scan2albedo.errors import ModelError
from scan2albedo.face_model.variation import EXPRESSION_BUMPS, IDENTITY_BUMPS, displacement
from scan2albedo.fitting.linear_model import _State, _Term, fit_linear_model
from scan2albedo.geometry.mesh import vertex_normals
from scan2albedo.geometry.rigid import (
    Similarity,
    compose,
    invert_rigid,
    rotation_from_vector,
    transform_points,
)
from scan2albedo.io.linear_model_files import LinearFaceModel
from scan2albedo.templates.annotated_face_model import linear_model_places

MODEL = AnnotatedFaceModel.default()


@pytest.fixture(scope="module")
def linear():
    """The default model's surface with bumps of identities and expressions, upside down, in metres."""
    vertices, faces = MODEL.surface(1)
    parts = [[bump] for bump in IDENTITY_BUMPS[:12]]
    parts += [EXPRESSION_BUMPS[name] for name in ("smile", "pout", "surprise")]
    basis = [sum(displacement(bump, vertices, MODEL.landmarks) for bump in bumps) for bumps in parts]
    turn = np.diag([-1.0, -1.0, 1.0]) / 1000
    basis = (basis @ turn).astype(np.float32)
    return LinearFaceModel(vertices @ turn, basis, "bumps", "0" * 64, 12, faces)


@pytest.fixture(scope="module")
def jointed(linear):
    """The same with a jaw that turns the lower face."""
    y, z = 1000 * linear.mean[:, 1], 1000 * linear.mean[:, 2]
    jaw = np.clip((y - 40) / 25, 0, 1) * np.clip((z + 60) / 60, 0, 1)
    weights = np.stack([1 - jaw, jaw], 1)
    return replace(
        linear,
        joints=("root", "jaw"),
        parents=np.array([-1, 0]),
        weights=weights,
        joint_mean=np.array([[0, 0.05, -0.1], [0, 0.03, -0.05]]),
        joint_basis=np.zeros((15, 2, 3)),
    )


def scanned(model, coefficients, rotations=None):
    """Return a noisy scan in a pose of its own, its vertices without noise, and its pose."""
    true = 1000 * model.at(coefficients, rotations) @ np.diag([-1.0, -1.0, 1.0])
    noise = np.random.default_rng(0).normal(0, 0.1, (len(true), 1))
    pose = compose(rotation_from_vector([0.1, -0.1, 0.05]), [3.0, -4.0, 2.0])
    noisy = transform_points(pose, true + noise * vertex_normals(true, model.faces))
    return RawScan(noisy, model.faces), true, invert_rigid(pose)


def fitted_to(scan, model_from_scan, linear, weight=lambda fitted: np.ones(len(fitted.vertices)), **more):
    fitted = fit(scan, MODEL, model_from_scan)
    return fitted, fit_linear_model(scan, fitted, *linear_model_places(linear, MODEL), weight(fitted), **more)


def vertex_errors(found, fitted, model_from_scan, true):
    scan_from_model = invert_rigid(fitted.model_from_scan)
    own = transform_points(model_from_scan @ scan_from_model, found.vertices)
    return row_lengths(own - true)


def test_the_mean_is_placed_whatever_its_axes_and_unit(linear):
    placed, places = linear_model_places(linear, MODEL)
    assert placed.mm_per_unit == pytest.approx(1000)
    assert (places.face >= 0).all()
    assert places.barycentric.any(1).mean() > 0.8
    assert_array_equal(placed.faces, linear.faces)
    inside_out = replace(linear, faces=linear.faces[:, ::-1], uv=np.zeros((len(linear.faces), 3, 2)))
    assert_array_equal(linear_model_places(inside_out, MODEL)[0].faces, linear.faces)
    with pytest.raises(ModelError, match="linear model: bumps"):
        linear_model_places(replace(linear, mean=linear.mean * [1, 1, 0.01]), MODEL)


@pytest.mark.slow
def test_coefficients_of_its_own_shapes_come_back(linear):
    truth = np.random.default_rng(5).normal(size=15)
    scan, true, pose = scanned(linear, truth)
    fitted, found = fitted_to(scan, pose, linear)
    assert_array_equal(fitted_to(scan, pose, linear)[1].coefficients, found.coefficients)
    error = found.coefficients - truth
    assert found.converged
    assert rms(error) < 0.1
    assert rms(error / found.deviation[7:]) < 4
    assert np.median(vertex_errors(found, fitted, pose, true)) < 0.1
    assert found.noise_mm == pytest.approx(0.1, rel=0.5)
    assert np.nanmean(found.residual_mm) < 0.12
    assert found.pose.scale / 1000 == pytest.approx(1, abs=0.01)
    record = found.record(invert_rigid(fitted.model_from_scan))
    assert (len(record.shape), len(record.expression)) == (12, 3)
    again = transform_points(np.array(record.scan_from_model), linear.at(found.coefficients))
    direct = transform_points(invert_rigid(fitted.model_from_scan), found.vertices)
    assert_allclose(again, direct, atol=1e-6)


@pytest.mark.slow
def test_a_jaw_that_is_open_is_turned(jointed):
    truth, turns = np.random.default_rng(7).normal(size=15) * 0.7, np.array([[0.0, 0, 0], [0.2, 0, 0]])
    scan, true, pose = scanned(jointed, truth, turns)
    fitted, found = fitted_to(scan, pose, jointed)
    assert_allclose(found.rotations, turns, atol=0.05)
    assert np.median(vertex_errors(found, fitted, pose, true)) < 0.3
    assert len(found.deviation) == 7 + 3 + 15
    assert list(found.record(np.eye(4)).joint_deviations_rad) == ["jaw"]


def test_hair_and_holes_hardly_count(linear):
    truth = np.random.default_rng(9).normal(size=15)
    _, true, pose = scanned(linear, truth)
    hair = true[:, 1] > np.percentile(true[:, 1], 90)
    points = true + 12 * hair[:, None] * vertex_normals(true, linear.faces)
    gone = np.hypot(true[:, 0] - 40, true[:, 1] + 20) < 12
    kept = linear.faces[~gone[linear.faces].any(1)]
    hairy = RawScan(transform_points(invert_rigid(pose), points), kept)

    def skin(fitted):
        return (fitted.vertices[:, 1] < np.percentile(true[:, 1], 88)).astype(float)

    fitted, found = fitted_to(hairy, pose, linear, skin)
    off = vertex_errors(found, fitted, pose, true)
    assert np.median(off[~hair]) < 0.3
    assert np.isnan(found.residual_mm[gone]).mean() > 0.5
    assert np.nanmedian(found.displacement_mm[~hair]) == pytest.approx(0, abs=0.1)


def test_a_budget_ends_with_the_best_so_far(linear):
    scan, _, pose = scanned(linear, np.ones(15))
    _, found = fitted_to(scan, pose, linear, budget=Budget(evaluations=6))
    assert not found.converged
    assert np.isfinite(found.coefficients).all()
    assert 1 <= len(found.trace) <= 3
    assert found.trace.stages == ("linear_model",)
    assert found.plan[-1].level == "doubt"


def test_the_gradient_is_that_of_the_cost(jointed):
    """Central differences of minus the log posterior, over motion, size, jaw and coefficients."""
    rng = np.random.default_rng(0)
    index = np.arange(0, len(jointed.mean), 40)
    part = replace(jointed.of_vertices(index), mm_per_unit=1000.0)
    axes = rng.normal(size=(len(index), 1, 3))
    target = 1000 * part.mean + rng.normal(0, 2, part.mean.shape)
    weight = rng.random(len(index))
    plane = _Term(np.arange(len(index)), target, axes, weight, 1.3, 0.4)
    point = replace(plane, axes=np.broadcast_to(np.eye(3), (len(index), 3, 3)), scale=2.0)
    pose = Similarity(rotation_from_vector([0.1, 0.2, 0.3]), np.array([1.0, 2.0, 3.0]), 1010.0)
    turns = np.array([[0, 0, 0], [0.1, 0.05, -0.1]])
    meter, start = Meter("linear_model", "mm"), rng.normal(size=15) * 0.3
    state = _State(part, np.array([1]), meter, pose, start, turns, (plane, point))
    equations = state.normal_equations()
    steps = 1e-5 * np.eye(len(equations.gradient))
    slopes = [(state.moved(step).cost - state.moved(-step).cost) / 2e-5 for step in steps]
    assert equations.gradient == pytest.approx(slopes, rel=1e-3, abs=1e-3)


def test_correlated_errors_count_as_fewer_observations(linear):
    points = 1000 * linear.mean
    index, count = np.arange(len(points)), np.ones(len(points))
    axes = np.broadcast_to([0.0, 0, 1], (len(points), 1, 3))
    rng = np.random.default_rng(0)
    white = points + [0, 0, 1] * rng.normal(0, 0.3, (len(points), 1))
    waves = points + [0, 0, 0.3] * np.sin(points[:, :1] / 10) * np.sin(points[:, 1:2] / 10)
    alone, together = (_Term(index, y, axes, count).with_scale_of(points, count) for y in (white, waves))
    assert alone.share > 0.3
    assert together.share < 0.05
    assert alone.scale == pytest.approx(0.3, rel=0.25)  # t's scale of normal noise is a little less
