"""The template takes a person's shape, so that what people do neither moves the pose nor makes doubts."""

import numpy as np
from helpers.poses import REST

from scan2albedo.core import Budget, Meter
from scan2albedo.face_model.variation import STRETCHES, shape_modes
from scan2albedo.geometry.oriented_points import oriented_points
from scan2albedo.geometry.rigid import Similarity, rotation_from_vector
from scan2albedo.registration.icp import residuals, shaped_icp


def person_points(model, template, seed):
    """The samples of a face that the modes make, where the model lies."""
    coefficients = np.random.default_rng(seed).normal(size=template.modes.shape[2])
    moved = model.control_vertices + np.tensordot(coefficients, template.control_modes, 1)
    subdivision = model.subdivision(1)
    return oriented_points(subdivision.matrix @ moved, subdivision.faces, 4.0)


def test_no_mode_moves_turns_or_grows_the_face(model):
    modes = shape_modes(model, np.ones(len(model.control_vertices)))
    rest = model.control_vertices - model.control_vertices.mean(0)
    assert np.abs(modes.mean(1)).max() < 1e-9
    assert np.abs(np.cross(rest, modes).mean(1)).max() < 1e-8
    assert np.abs((modes * rest).sum((1, 2))).max() < 1e-6
    assert (np.abs(modes).max((1, 2)) > 0.1).all()


def test_the_pose_of_a_person_is_found_and_the_surface_lies_on_the_scan(model, template):
    scan = person_points(model, template, 3)
    start = Similarity(rotation_from_vector([0.1, -0.08, 0.05]), np.array([4.0, -3.0, 5.0]))
    shaped = shaped_icp(scan, template, start, Meter("icp", "mm"))
    assert shaped.pose.is_near(REST, np.radians(1.5), 1.5)
    person = template.in_shape(shaped.coefficients)
    before, after = (
        residuals(scan, one.samples, shaped.pose).trimmed_rms_mm(template.samples.areas)
        for one in (template, person)
    )
    assert after < 0.6 * before


def test_what_moves_beside_the_heavy_points_does_not_turn_them(model):
    chin = model.control_vertices[:, 1] < -30
    assert 10 < chin.sum() < len(chin) / 2
    modes = shape_modes(model, np.where(chin, 1e-6, 1.0))
    rest = model.control_vertices[~chin] - model.control_vertices[~chin].mean(0)
    assert np.abs(modes[:, ~chin].mean(1)).max() < 1e-4
    assert np.abs(np.cross(rest, modes[:, ~chin]).mean(1)).max() < 1e-3


def test_it_records_a_falling_loss_and_stops_with_the_budget(model, template):
    scan = person_points(model, template, 4)
    start = Similarity(np.eye(3), np.array([3.0, 2.0, -4.0]))
    whole, little = Meter("icp", "mm"), Meter("icp", "mm", Budget(evaluations=2))
    shaped_icp(scan, template, start, whole)
    errors = [row.error for row in whole.rows]
    assert {row.stage for row in whole.rows} == {"shaped_icp"}
    assert len(errors) > 4
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 0.6 * errors[0]
    shaped_icp(scan, template, start, little)
    assert little.evaluations == 2
    shaped_icp(scan, template, start, whole)
    assert [row.error for row in whole.rows] == sorted((row.error for row in whole.rows), reverse=True)


def test_width_height_and_depth_come_first(model):
    rest = model.control_vertices - model.control_vertices.mean(0)
    for axis, mode in enumerate(shape_modes(model, np.ones(len(model.control_vertices)))[STRETCHES]):
        share = (mode * rest).sum(0) / (rest**2).sum(0)
        assert np.argmax(share) == axis
