"""The depth-derivative objective and its annealing, with the model as its own scan."""

import numpy as np
import pytest

from scan2albedo.core import Budget, Meter
from scan2albedo.geometry.rigid import Similarity, invert_rigid, rotation_angle_rad, rotation_from_vector
from scan2albedo.registration import RegistrationOptions
from scan2albedo.registration.depth_annealing import (
    DepthDerivativeObjective,
    anneal_depth_derivatives,
    annealed,
)
from scan2albedo.registration.icp import rigid_distance_mm
from scan2albedo.registration.inputs import Template, prepared_scan

REST = Similarity(np.eye(3), np.zeros(3))


@pytest.fixture(scope="module")
def template(model) -> Template:
    return Template.of(model, 0)


def test_the_objective_is_zero_at_the_truth_and_grows_away_from_it(template):
    scan = template.coarse_vertices, template.coarse_faces
    objective = DepthDerivativeObjective(*scan, template, REST, 64)
    assert objective(np.zeros(5)) == 0
    for axis, unit in enumerate([np.radians(1)] * 3 + [1.0] * 2):
        costs = [objective(step * unit * np.eye(5)[axis]) for step in (1, 2, 4)]
        assert 0 < costs[0] < costs[1] < costs[2] < 1


def test_derivatives_do_not_see_depth_but_the_shift_is_found_apart(template):
    lifted = template.coarse_vertices + [0, 0, 3.5]
    objective = DepthDerivativeObjective(lifted, template.coarse_faces, template, REST, 64)
    assert objective(np.zeros(5)) < 1e-9
    assert objective.depth_shift_mm(np.zeros(5)) == pytest.approx(3.5)


def test_a_missing_part_of_the_scan_costs_nothing(template):
    half = template.coarse_faces[(template.coarse_vertices[template.coarse_faces][..., 0] > 0).all(1)]
    objective = DepthDerivativeObjective(template.coarse_vertices, half, template, REST, 64)
    assert objective(np.zeros(5)) == 0


@pytest.mark.parametrize("scale", [1.0, 0.93])
def test_annealing_walks_back_from_four_degrees_and_four_millimetres(template, scale):
    scan = scale * template.coarse_vertices, template.coarse_faces
    start = Similarity(rotation_from_vector(np.radians([2.5, -3, 1])), np.array([3.0, -2.0, 2.0]), scale)
    meter = Meter("depth_annealing", "objective")
    found = anneal_depth_derivatives(*scan, template, start, size=64, evaluations=1500, seed=0, meter=meter)
    assert found.converged
    assert found.error < 0.35 * found.start_error
    assert np.degrees(rotation_angle_rad(found.pose.rotation)) < 0.6
    assert np.linalg.norm(found.pose.translation) < 0.8
    errors = [row.error for row in meter.trace]
    assert errors[0] == found.start_error
    assert errors[-1] == found.error


def test_a_budget_ends_it_with_the_best_so_far(template):
    scan = template.coarse_vertices, template.coarse_faces
    start = Similarity(rotation_from_vector([0.05, 0, 0]), np.zeros(3))
    meter = Meter("depth_annealing", "objective", Budget(evaluations=40))
    found = anneal_depth_derivatives(*scan, template, start, size=64, evaluations=1500, seed=0, meter=meter)
    assert not found.converged
    assert meter.evaluations <= 43
    assert found.error <= found.start_error


@pytest.mark.parametrize("seed", [0, 3])
@pytest.mark.parametrize("off_deg", [0.0, 1.0, 4.0, 25.0])
def test_annealing_never_leaves_the_surface_farther_than_it_was(synthetic_scan, template, seed, off_deg):
    example = synthetic_scan(seed)
    scan = prepared_scan(example.scan, RegistrationOptions())
    truth = scan.prepared_from_scan @ invert_rigid(example.model_from_scan)
    turn = rotation_from_vector(np.radians(off_deg) * np.array([0.6, -0.64, 0.48]))
    start = Similarity(truth[:3, :3] @ turn, truth[:3, 3] + [0.5 * off_deg, 0, 0])
    meter = Meter("depth_annealing", "objective")
    options = RegistrationOptions(force_annealing=True)
    found, step = annealed(scan, template, start, options, meter, 0)
    for sigma_mm in (0.5, 2.0):
        before, after = (rigid_distance_mm(scan.samples, template, p, sigma_mm) for p in (start, found.pose))
        assert after <= before
    kept = np.array_equal(found.pose.rotation, start.rotation)
    assert ("dropped" in step.reason) == kept
    if off_deg == 4.0:
        assert np.degrees(rotation_angle_rad(found.pose.rotation.T @ truth[:3, :3])) < 3.9
