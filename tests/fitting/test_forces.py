import numpy as np
import pytest

from scan2albedo.fitting.forces import ForceGates, robust_weights, scan_forces
from scan2albedo.fitting.scan_surface import scan_near_model
from tests.fitting.conftest import mask_surface

GATES = ForceGates(10.0, 0.6, 0.1, 3.0, 0.5)


def plane_scan(size: int = 21):
    vertices, faces = mask_surface(size)
    vertices = vertices * [1, 1, 0]
    return scan_near_model(vertices, faces, np.eye(4), vertices.min(0) - 500, vertices.max(0) + 500)


UP = np.array([[0.0, 0.0, 1.0]])


def test_pull_is_one_across_and_a_tenth_along_the_surface():
    forces = scan_forces(plane_scan(), np.array([[5.0, 5.0, 2.0]]), UP, GATES)
    assert forces.force[0] == pytest.approx(forces.weight[0] * np.array([0, 0, -2.0]), abs=1e-9)
    assert 0 < forces.weight[0] <= 1


@pytest.mark.parametrize(
    ("point", "normal"),
    [
        ([5.0, 5.0, 12.0], UP),  # beyond the gate
        ([5.0, 5.0, 2.0], -UP),  # looks the other way
        ([75.0, 5.0, 0.0], UP),  # beside the scan's border
    ],
)
def test_closed_gates_pull_at_nothing(point, normal):
    forces = scan_forces(plane_scan(), np.array([point]), normal, GATES)
    assert not forces.force.any()
    assert not forces.weight.any()


def test_robust_weights_fall_with_the_residual_and_forget_outliers():
    residual = np.concatenate([np.linspace(-1, 1, 101), [50.0]])
    weights = robust_weights(residual, np.ones(102, bool), GATES)
    assert weights[50] == pytest.approx(1)
    assert weights[100] > 0.6
    assert weights[101] < 1e-3


def test_seams_are_no_borders_and_floaters_pull_at_nothing():
    vertices, faces = mask_surface(41)
    left = np.flatnonzero((vertices[faces, 0].mean(1)) < 0)
    right = np.flatnonzero((vertices[faces, 0].mean(1)) >= 0)
    split = np.concatenate([vertices, vertices, [[0, 0, 300], [1, 0, 300], [0, 1, 300]]])
    count = len(vertices)
    index = np.concatenate([faces[left], faces[right] + count, [[2 * count, 2 * count + 1, 2 * count + 2]]])
    surface = scan_near_model(split, index, np.eye(4), split.min(0), split.max(0))
    assert len(surface.vertices) == count
    assert surface.boundary.sum() == 4 * 40


def test_a_scan_elsewhere_gives_none():
    vertices, faces = mask_surface(5)
    assert scan_near_model(vertices + 1e4, faces, np.eye(4), vertices.min(0), vertices.max(0)) is None
