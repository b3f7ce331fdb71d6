"""The template takes a person's shape, so that what people do neither moves the pose nor makes doubts."""

import numpy as np
import pytest

from scan2albedo.core import Budget, Meter
from scan2albedo.face_model.variation import STRETCHES, shape_modes
from scan2albedo.geometry.oriented_points import oriented_points
from scan2albedo.geometry.rigid import Similarity, rotation_angle_rad, rotation_from_vector
from scan2albedo.registration.icp import residuals, shaped_icp
from scan2albedo.registration.inputs import Template


@pytest.fixture(scope="module")
def template(model):
    return Template.of(model, 0)


def person_points(model, template, coefficients):
    """The samples of a face that the modes make, where the model lies."""
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
    drawn = np.random.default_rng(3).normal(size=template.modes.shape[2])
    scan = person_points(model, template, drawn)
    start = Similarity(rotation_from_vector([0.1, -0.08, 0.05]), np.array([4.0, -3.0, 5.0]))
    shaped = shaped_icp(scan, template, start, Meter("icp", "mm"))
    assert np.degrees(rotation_angle_rad(shaped.pose.rotation)) < 1.5
    assert np.linalg.norm(shaped.pose.translation) < 1.5
    person = template.in_shape(shaped.coefficients)
    before = residuals(scan, template.samples, shaped.pose).trimmed_rms_mm(template.samples.areas)
    after = residuals(scan, person.samples, shaped.pose).trimmed_rms_mm(template.samples.areas)
    assert after < 0.6 * before


def test_what_moves_beside_the_heavy_points_does_not_turn_them(model):
    chin = model.control_vertices[:, 1] < -30
    assert 10 < chin.sum() < len(chin) / 2
    modes = shape_modes(model, np.where(chin, 1e-6, 1.0))
    rest = model.control_vertices[~chin] - model.control_vertices[~chin].mean(0)
    assert np.abs(modes[:, ~chin].mean(1)).max() < 1e-4
    assert np.abs(np.cross(rest, modes[:, ~chin]).mean(1)).max() < 1e-3


def test_it_records_a_falling_loss_and_stops_with_the_budget(model, template):
    scan = person_points(model, template, np.random.default_rng(4).normal(size=template.modes.shape[2]))
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
