"""The depth-derivative objective and its annealing, with the model as its own scan."""

import numpy as np
import pytest
from helpers.poses import REST

from scan2albedo.core import Budget, Meter
from scan2albedo.geometry.rigid import Similarity, invert_rigid, rotation_angle_rad, rotation_from_vector
from scan2albedo.optimization.annealing import simulated_annealing
from scan2albedo.registration import RegistrationOptions
from scan2albedo.registration.depth_annealing import REACH, DepthDerivativeObjective, annealed
from scan2albedo.registration.icp import rigid_distance_mm
from scan2albedo.registration.inputs import prepared_scan


def test_the_objective_is_zero_at_the_truth_and_grows_away_from_it(template):
    objective = DepthDerivativeObjective(template.surface, template.image.faces, template, REST, 64)
    assert objective(np.zeros(5)) == 0
    for axis, unit in enumerate([np.radians(1)] * 3 + [1.0] * 2):
        costs = [objective(step * unit * np.eye(5)[axis]) for step in (1, 2, 4)]
        assert 0 < costs[0] < costs[1] < costs[2] < 1
    # A missing part of the scan costs nothing.
    half = template.image.faces[(template.surface[template.image.faces][..., 0] > 0).all(1)]
    assert DepthDerivativeObjective(template.surface, half, template, REST, 64)(np.zeros(5)) == 0


def test_derivatives_do_not_see_depth_but_the_shift_is_found_apart(template):
    lifted = template.surface + [0, 0, 3.5]
    objective = DepthDerivativeObjective(lifted, template.image.faces, template, REST, 64)
    assert objective(np.zeros(5)) < 1e-9
    np.testing.assert_allclose(objective.pose(np.zeros(5)).matrix()[:3, 3], [0, 0, 3.5], atol=1e-9)


@pytest.mark.parametrize("scale", [1.0, 0.93])
def test_annealing_walks_back_from_four_degrees_and_four_millimetres(template, scale):
    start = Similarity(rotation_from_vector(np.radians([2.5, -3, 1])), np.array([3.0, -2.0, 2.0]), scale)
    scan = scale * template.surface, template.image.faces
    objective, here = DepthDerivativeObjective(*scan, template, start, 64), np.zeros(5)
    found = simulated_annealing(objective, here, -REACH, REACH, seed=0, evaluations=1500)
    assert found.cost < 0.35 * objective(here)
    pose = objective.pose(found.x)
    assert np.degrees(rotation_angle_rad(pose.rotation)) < 0.6
    assert np.linalg.norm(pose.translation) < 0.8


def prepared(example):
    """A scan as registration takes it, and where the model lies in it."""
    scan = prepared_scan(example.scan, RegistrationOptions())
    return scan, scan.prepared_from_scan @ invert_rigid(example.model_from_scan)


FORCED = RegistrationOptions(force_annealing=True)


def test_a_budget_ends_it_with_the_best_so_far(synthetic_scan, template):
    scan, truth = prepared(synthetic_scan(0))
    start = Similarity(truth[:3, :3] @ rotation_from_vector([0.05, 0, 0]), truth[:3, 3])
    meter = Meter("depth_annealing", "objective", Budget(evaluations=40))
    found = annealed(scan, template, start, FORCED, meter, 0)
    errors = [row.error for row in meter.trace]
    assert meter.exhausted
    assert errors == sorted(errors, reverse=True)
    assert found.error in (errors[0], errors[-1])


@pytest.mark.parametrize("seed", [0, 3])
@pytest.mark.parametrize("off_deg", [0.0, 1.0, 4.0, 25.0])
def test_annealing_never_leaves_the_surface_farther_than_it_was(synthetic_scan, template, seed, off_deg):
    scan, truth = prepared(synthetic_scan(seed))
    turn = rotation_from_vector(np.radians(off_deg) * np.array([0.6, -0.64, 0.48]))
    start = Similarity(truth[:3, :3] @ turn, truth[:3, 3] + [0.5 * off_deg, 0, 0])
    found = annealed(scan, template, start, FORCED, Meter("depth_annealing", "objective"), 0)
    for sigma_mm in (0.5, 2.0):
        before, after = (rigid_distance_mm(scan.samples, template, p, sigma_mm) for p in (start, found.pose))
        assert after <= before
    kept = np.array_equal(found.pose.rotation, start.rotation)
    assert ("dropped" in found.step.reason) == kept
    if off_deg == 4.0:
        assert np.degrees(rotation_angle_rad(found.pose.rotation.T @ truth[:3, :3])) < 3.9
