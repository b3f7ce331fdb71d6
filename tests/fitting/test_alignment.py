"""The face gets the scan's proportions before it bends."""

import numpy as np
import pytest

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
    return RawScan(stretched(vertices), faces, name="other proportions")


def found(model, scan, reference, *, iterations=8, budget=None):
    options = FitOptions(proportion_iterations=iterations)
    low, high = reference.min(0) - 50, reference.max(0) + 50
    surface = scan_near_model(scan.vertices, scan.faces, np.eye(4), low, high, options.smoothing_mm)
    samples = SurfaceSamples.of(model, reference, 0)
    return proportioned(surface, samples, reference, options, Meter("fit", "mm", Budget.of(budget)))


def test_a_stretch_within_the_modes_is_found(model, scan):
    reference = model.control_vertices
    truth = stretched(model.landmarks)[17:]
    before = np.linalg.norm(model.landmarks[17:] - truth, axis=1).mean()
    after = np.linalg.norm(model.landmarks_of(found(model, scan, reference))[17:] - truth, axis=1).mean()
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
    vertices, faces = model.surface(2)
    same = found(model, RawScan(vertices, faces), model.control_vertices)
    assert np.abs(same - model.control_vertices).max() < 0.3


def test_the_face_stays_symmetric_whatever_one_side_of_the_scan_says(model, scan):
    vertices = scan.vertices.copy()
    vertices[:, 2] -= 8 * np.exp(-np.sum((vertices - [35, -20, 0]) ** 2 * [1, 1, 0], axis=1) / 200)
    control = model.control_vertices
    mirror = np.argmin(np.linalg.norm(control[:, None] * [-1, 1, 1] - control[None], axis=2), axis=1)
    shape = found(model, RawScan(vertices, scan.faces), control)
    mirrored = shape[mirror] * [-1, 1, 1]
    aligned = transform_points(procrustes(mirrored, shape), mirrored)
    assert np.linalg.norm(shape - control, axis=1).mean() > 1
    assert np.linalg.norm(aligned - shape, axis=1).max() < 0.05


def test_no_iterations_and_no_budget_leave_the_reference(model, scan):
    reference = model.control_vertices
    np.testing.assert_array_equal(found(model, scan, reference, iterations=0), reference)
    np.testing.assert_array_equal(found(model, scan, reference, budget=1e-9), reference)
