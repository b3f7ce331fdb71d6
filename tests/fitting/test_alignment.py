"""The face gets the scan's proportions before it bends."""

import numpy as np
import pytest
from helpers.measures import row_lengths
from scipy.spatial import cKDTree

from scan2albedo.core import Budget, Meter
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.fitting import FitOptions, fit
from scan2albedo.fitting.alignment import proportioned
from scan2albedo.fitting.samples import SurfaceSamples
from scan2albedo.fitting.scan_surface import scan_near_model
from scan2albedo.geometry.rigid import procrustes, transform_points


def stretched(points):
    """A face with a shorter nose, a longer chin and flatter cheeks."""
    x, y, z = points.T
    shift = 6 * np.tanh(y / 40)
    return np.column_stack([x, y - shift, z - 4 * (x / 60) ** 2])


@pytest.fixture(scope="module")
def scan(model):
    vertices, faces = model.surface(2)
    return RawScan(stretched(vertices), faces)


def found(model, scan, iterations=8, budget=None):
    """Control points of the model with the scan's proportions."""
    reference, options = model.control_vertices, FitOptions(proportion_iterations=iterations)
    low, high = reference.min(0) - 50, reference.max(0) + 50
    surface = scan_near_model(scan.vertices, scan.faces, np.eye(4), low, high, options.smoothing_mm)
    samples = SurfaceSamples.of(model, reference, 0)
    return proportioned(surface, samples, reference, options, Meter("fit", "mm", Budget.of(budget)))


def test_a_stretch_within_the_modes_is_found(model, scan):
    truth, landmarks = stretched(model.landmarks), model.landmarks_of(found(model, scan))
    before, after = (row_lengths(places - truth)[17:].mean() for places in (model.landmarks, landmarks))
    assert before > 3
    assert after < 0.4 * before


@pytest.mark.slow
@pytest.mark.parametrize("person", ["person3", "person4"])
def test_it_lowers_the_landmark_error_on_people_unlike_the_model(ict, model, person):
    scan, pose, errors_mm = ict.scan_of(person, model)
    plain, proportioned_too = (
        errors_mm(fit(scan, model, pose, options=FitOptions(proportion_iterations=iterations)))[17:].mean()
        for iterations in (0, 8)
    )
    assert proportioned_too < 0.95 * plain


def test_the_model_itself_stays_as_it_is(model):
    same = found(model, RawScan(*model.surface(2)))
    assert np.abs(same - model.control_vertices).max() < 0.3


def test_the_face_stays_symmetric_whatever_one_side_of_the_scan_says(model, scan):
    vertices = scan.vertices.copy()
    vertices[:, 2] -= 8 * np.exp(-np.sum((vertices - [35, -20, 0]) ** 2 * [1, 1, 0], axis=1) / 200)
    control = model.control_vertices
    mirror = cKDTree(control).query(control * [-1, 1, 1])[1]
    shape = found(model, RawScan(vertices, scan.faces))
    mirrored = shape[mirror] * [-1, 1, 1]
    aligned = transform_points(procrustes(mirrored, shape), mirrored)
    assert row_lengths(shape - control).mean() > 1
    assert row_lengths(aligned - shape).max() < 0.05


def test_no_iterations_and_no_budget_leave_the_reference(model, scan):
    for none in ({"iterations": 0}, {"budget": 1e-9}):
        np.testing.assert_array_equal(found(model, scan, **none), model.control_vertices)
