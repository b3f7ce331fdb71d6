from types import SimpleNamespace

import numpy as np
import pytest
from helpers.crossings import crossing_triangles
from helpers.measures import row_lengths
from helpers.poses import moved
from numpy.testing import assert_allclose, assert_array_equal
from worlds.raw_like import raw_like

from scan2albedo import load_scan
from scan2albedo.core import Budget
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.errors import FitError
from scan2albedo.fitting import FitOptions, fit
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import face_normals, vertex_normals
from scan2albedo.geometry.rigid import (
    compose,
    invert_rigid,
    procrustes,
    rotation_angle_rad,
    rotation_from_vector,
    transform_points,
)


def surface_error_mm(fitted, truth_in_scan):
    """Distances of points in the scan's frame to a fitted surface."""
    points = transform_points(fitted.model_from_scan, truth_in_scan)
    return ClosestPointQuery(fitted.vertices, fitted.faces).query(points).distance


@pytest.fixture(scope="module")
def mask_fit(mask_model, mask_scan):
    return fit(mask_scan, mask_model, np.eye(4))


def test_another_shape_is_reached(mask_fit, mask_scan):
    error = surface_error_mm(mask_fit, mask_scan.vertices)
    assert np.median(error) < 0.1
    assert np.percentile(error, 90) < 0.7
    assert mask_fit.converged
    assert mask_fit.metrics["flipped_faces"] == 0
    assert mask_fit.metrics["coverage"] > 0.85
    assert mask_fit.metrics["residual_mean_mm"] < 0.2


def test_result_is_consistent(mask_fit, mask_model):
    subdivision = mask_model.subdivision(mask_fit.levels)
    assert_allclose(mask_fit.vertices, subdivision.matrix @ mask_fit.control_points)
    assert mask_fit.region.shape == (len(mask_fit.faces),)
    chart = np.column_stack([mask_fit.uv, np.zeros(len(mask_fit.uv))])
    assert (face_normals(chart, mask_fit.faces)[:, 2] > 0).all()
    assert mask_fit.landmarks is None
    assert mask_fit.iterations == mask_fit.trace.rows[-1].evaluations == len(mask_fit.trace)
    assert {(row.stage, row.unit) for row in mask_fit.trace} == {("fit", "mm")}
    assert_allclose(mask_fit.template_vertices, mask_model.template_of(mask_fit.control_points))


def test_inputs_stay_as_they_were_and_the_answer_repeats(mask_fit, mask_model, mask_scan):
    before = mask_scan.vertices.copy(), mask_model.control_vertices.copy()
    again = fit(mask_scan, mask_model, SimpleNamespace(model_from_scan=np.eye(4)))
    assert_array_equal(mask_scan.vertices, before[0])
    assert_array_equal(mask_model.control_vertices, before[1])
    assert_array_equal(again.vertices, mask_fit.vertices)


def test_a_template_fits_itself_with_nothing_to_do(mask_model):
    vertices, faces = mask_model.surface(2)
    fitted = fit(RawScan(vertices, faces), mask_model, np.eye(4))
    assert rotation_angle_rad(fitted.model_from_scan[:3, :3]) < 1e-3
    assert fitted.metrics["scale"] == pytest.approx(1, abs=1e-3)
    assert np.abs(fitted.control_points - mask_model.control_vertices).max() < 0.3


def test_pose_and_size_are_refined_before_anything_bends(mask_model):
    vertices, faces = mask_model.surface(2)
    # By ten degrees and ten millimetres.
    off = compose(rotation_from_vector(np.deg2rad([6, -6.4, 4.8])), [6.0, 4.8, -6.4])
    fitted = fit(RawScan(1.1 * vertices, faces), mask_model, off)
    assert fitted.metrics["scale"] == pytest.approx(1.1, abs=0.05)
    assert np.rad2deg(rotation_angle_rad(fitted.model_from_scan[:3, :3])) < 0.5
    front, *laid = transform_points(fitted.model_from_scan, 1.1 * np.vstack([mask_model.front, vertices]))
    # The front of a larger face keeps the model's place.
    assert np.linalg.norm(front - mask_model.front) < 1.0
    assert row_lengths(fitted.vertices - laid).mean() < 2.0


def test_the_scan_may_lie_anywhere(mask_fit, mask_model, mask_scan):
    pose = compose(rotation_from_vector([0.3, -2.0, 1.0]), [1e6, -2e6, 3e5])
    fitted = fit(moved(mask_scan, pose), mask_model, invert_rigid(pose))
    assert_allclose(fitted.vertices, mask_fit.vertices, atol=0.02)


def test_a_hole_has_no_residual_and_keeps_its_shape(mask_model, mask_scan):
    centre = mask_scan.vertices[mask_scan.faces].mean(1)
    hole = row_lengths(centre[:, :2] - [-35, 40]) < 15
    fitted = fit(mask_scan.without_faces(hole), mask_model, np.eye(4))
    across = row_lengths(fitted.vertices[:, :2] - [-35, 40])
    assert np.isnan(fitted.residual_mm[across < 8]).all()
    assert np.isfinite(fitted.residual_mm[(across > 20) & (across < 30)]).all()
    assert surface_error_mm(fitted, centre[hole]).max() < 1.5


def test_a_budget_ends_the_fit_with_what_there_is_and_more_never_ends_worse(mask_fit, mask_model, mask_scan):
    medians = []
    for evaluations in (1, 5, 35, 60):
        fitted = fit(mask_scan, mask_model, np.eye(4), Budget(evaluations=evaluations))
        assert not fitted.converged
        assert fitted.iterations == evaluations
        medians.append(np.median(surface_error_mm(fitted, mask_scan.vertices)))
    assert (np.diff([*medians, mask_fit.metrics["residual_median_mm"]]) < 0).all()


def test_next_to_no_time_still_brings_the_model_nearer(mask_model, mask_scan):
    scan = mask_scan.vertices
    fitted = fit(mask_scan, mask_model, np.eye(4), 1e-6)
    before = ClosestPointQuery(*mask_model.surface(1)).query(scan).distance
    assert np.median(surface_error_mm(fitted, scan)) < 0.8 * np.median(before)
    assert not fitted.converged
    assert fitted.iterations == 2


def test_a_scan_elsewhere_and_a_pose_of_another_shape_are_refused_with_the_reason(mask_model, mask_scan):
    with pytest.raises(FitError, match=r"% of the model has scan"):
        fit(mask_scan, mask_model, compose(np.eye(3), [0.0, 0.0, 130.0]))
    with pytest.raises(ValueError, match="model_from_scan"):
        fit(mask_scan, mask_model, np.eye(3))


CEILINGS = {
    "generic_neutral": (0.35, 0.16, 1.1),
    "person1": (0.37, 0.18, 1.6),
    "person2": (0.38, 0.20, 1.9),
    "person4": (0.45, 0.21, 2.0),
    "generic_mouthSmile_L_mouthSmile_R": (0.35, 0.17, 1.5),
    "generic_jawOpen0.7": (0.50, 0.17, 1.9),
}
"""Surface mean, surface median, dense correspondence mean [mm], about a fifth above what was measured."""


@pytest.mark.slow
@pytest.mark.parametrize("name", CEILINGS)
def test_error_ceilings_on_raw_like_scans(ict, name):
    shape = ict.shapes[name]
    scan, scan_from_shape = raw_like(shape, ict.faces, 1)
    pose = procrustes(shape[ict.landmarks[17:48]], ict.model.landmarks[17:48])
    fitted = fit(scan, ict.model, pose @ invert_rigid(scan_from_shape))
    inner = transform_points(scan_from_shape, shape[: ict.inner_vertices])
    error = surface_error_mm(fitted, inner)
    apart = fitted.template_vertices[: len(inner)] - transform_points(fitted.model_from_scan, inner)
    figures = error.mean(), np.median(error), row_lengths(apart).mean()
    assert (np.array(figures) < CEILINGS[name]).all(), figures
    assert fitted.metrics["flipped_faces"] == 0


@pytest.mark.slow
def test_finer_samples_at_the_end_lower_the_error_of_fine_scans_and_cost_coarse_ones_nothing(model):
    found = {}
    for level in (2, 3):
        vertices, faces = model.surface(level)
        shape = vertices * [1.05, 0.97, 1.0]
        shape[:, 2] += 2 * np.sin(shape[:, 1] / 15)
        noise = np.random.default_rng(0).normal(0, 0.3, (len(shape), 1))
        scan = RawScan(shape + noise * vertex_normals(shape, faces), faces)
        for finest in (0, 2):
            fitted = fit(scan, model, np.eye(4), options=FitOptions(finest_level=finest))
            found[level, finest] = surface_error_mm(fitted, shape).mean(), fitted.iterations
    assert found[2, 2] == found[2, 0]
    assert found[3, 2][0] < 0.9 * found[3, 0][0]
    assert found[3, 2][1] > found[3, 0][1]


def test_a_measured_person_is_reached_without_crossings(shared_data, model):
    truth = np.loadtxt(shared_data / "james_ibug68.csv", delimiter=",")
    pose = procrustes(truth[27:], model.landmarks[27:])
    fitted = fit(load_scan(shared_data / "james.obj"), model, pose)
    assert fitted.metrics["residual_mean_mm"] < 0.15
    assert fitted.metrics["coverage"] > 0.9
    coarse = model.subdivision(1)
    assert crossing_triangles(coarse.matrix @ fitted.control_points, coarse.faces) == 0
