"""Placed landmarks draw the fit along the face, and a wrong one is found and told."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.measures import row_lengths

from scan2albedo import RawScan, fit
from scan2albedo.core.landmarks import PlacedLandmarks
from scan2albedo.fitting import FitOptions
from scan2albedo.fitting.landmark_pull import LandmarkPull
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.synthetic.face_shape import person

FIVE = [36, 45, 30, 48, 54]
INNER = np.arange(17, 68)


QUICK = FitOptions(levels=(0, 0), finest_level=0)


@pytest.fixture(scope="module")
def case(model):
    """A person whose features all lie 4 mm beside where shape shows them, as if drawn on the skin."""
    control = person(model, np.random.default_rng(5))
    surface = model.subdivision(2).matrix @ control, model.subdivision(2).faces
    beside = model.landmarks_of(control) + (4.0, 0.0, 0.0)
    return RawScan(*surface), ClosestPointQuery(*surface).query(beside).points


def points(true, numbers, noise_mm=0.0):
    chosen = np.full((68, 3), np.nan)
    chosen[numbers] = true[numbers] + np.random.default_rng(1).normal(scale=noise_mm, size=(len(numbers), 3))
    return chosen


def fitted(case, model, marks=None):
    """Return the fit, the errors of its landmarks and its doubts."""
    scan, true = case
    face = fit(replace(scan, landmarks=marks), model, np.eye(4), options=QUICK)
    error = row_lengths(face.landmarks - transform_points(face.model_from_scan, true))
    return face, error, [step.text for step in face.plan]


def test_landmarks_are_followed_and_the_surface_stays_on_the_scan(case, model):
    free, before, _ = fitted(case, model)
    face, error, told = fitted(case, model, points(case[1], INNER, 0.5))
    assert told == []
    assert before[INNER].mean() > 3
    assert error[INNER].mean() < 1
    assert np.nanmean(face.residual_mm) < np.nanmean(free.residual_mm) + 0.05
    assert (face.landmark_deviation_mm[INNER] < free.landmark_deviation_mm[INNER]).all()
    assert (face.landmark_deviation_mm[:17] > 4).all()


def test_one_of_five_that_is_25_mm_off_is_told_and_does_no_harm(case, model):
    marks = points(case[1], FIVE, 1.0)
    marks[54] += (15, 16, 12)
    _, error, (told,) = fitted(case, model, marks)
    assert "1 of 5 landmarks (number 54) lie more than 15 mm" in told
    marks[54] = np.nan
    _, alone, _ = fitted(case, model, marks)
    assert error[INNER].mean() < alone[INNER].mean() + 0.1


def test_landmarks_in_another_unit_are_all_left_out(case, model):
    free, _, _ = fitted(case, model)
    face, _, told = fitted(case, model, 10 * points(case[1], FIVE))
    assert "5 of 5 landmarks" in told[0]
    assert np.abs(face.vertices - free.vertices).max() < 1.0


def test_a_lone_landmark_moves_its_surroundings_alone(model):
    control = model.control_vertices
    marks = PlacedLandmarks.of({48: model.landmarks[48] + (0, 4, 0)})
    pull = LandmarkPull.of(model, marks, np.eye(4))
    believed, wrong = pull.without_wrong(model, control)
    assert len(wrong) == 0
    moved = model.landmarks_of(believed.followed(model, control)) - model.landmarks
    assert 2.5 < moved[48, 1] < 4
    assert np.abs(moved[[19, 24, 27, 36, 45]]).max() < 0.4


def test_models_without_landmarks_leave_them_aside(model):
    bare = replace(model, landmark_points=None)
    assert LandmarkPull.of(bare, PlacedLandmarks.of({30: (0, 0, 0)}), np.eye(4)) is None


@pytest.mark.parametrize("sigma_mm", [1e-12, 1e12])
def test_points_that_are_said_to_be_perfect_or_worthless_break_nothing(case, model, sigma_mm):
    free, before, _ = fitted(case, model)
    marks = PlacedLandmarks(points(case[1], FIVE), np.full(68, sigma_mm))
    face, errors, _ = fitted(case, model, marks)
    assert np.isfinite(face.vertices).all()
    assert np.nanmean(face.residual_mm) < np.nanmean(free.residual_mm) + 0.1
    error = errors[FIVE].mean()
    assert error < 1 if sigma_mm < 1 else error == pytest.approx(before[FIVE].mean(), abs=0.3)
