import numpy as np
import pytest

from scan2albedo.face_model import AnnotatedFaceModel
from scan2albedo.fitting import FitOptions
from scan2albedo.fitting.mouth_corners import PULLS_MM, MouthCorners
from scan2albedo.fitting.scan_surface import scan_near_model
from scan2albedo.fitting.stages import Deformation, corners_pulled
from scan2albedo.optimization import Budget, Meter


@pytest.fixture(scope="module")
def model():
    return AnnotatedFaceModel.default()


@pytest.fixture(scope="module")
def corners(model):
    return MouthCorners.of(model, model.control_vertices)


def test_corners_move_up_and_out_and_the_rest_of_the_face_stays(model, corners):
    pulled = corners.pulled(model.control_vertices, 10.0, 10.0)
    moved = model.landmarks_of(pulled) - model.landmarks_of(model.control_vertices)
    length = np.linalg.norm(moved, axis=1)
    assert moved[48, 0] < -2 < 2 < moved[54, 0]
    assert (moved[[48, 54], 1] > 2).all()
    assert (length[[48, 54]] > 8).all()
    assert length[:48].max() < 1.5


def test_one_side_leaves_the_other(model, corners):
    pulled = corners.pulled(model.control_vertices, 10.0, 0.0)
    length = np.linalg.norm(model.landmarks_of(pulled) - model.landmarks_of(model.control_vertices), axis=1)
    assert length[48] > 8
    assert length[54] < 1


def test_the_sides_judge_half_a_mouth_each(model, corners):
    sampling = model.subdivision(1).matrix
    points = sampling @ model.control_vertices
    right, left = corners.sides(sampling)
    assert not (right & left).any()
    assert points[right, 0].mean() < -10
    assert points[left, 0].mean() > 10


def start_on(model, surface, budget=None):
    vertices, faces = surface
    scan = scan_near_model(vertices, faces, np.eye(4), vertices.min(0), vertices.max(0))
    meter = Meter("fit", "mm", Budget.of(budget), None)
    return corners_pulled(Deformation(model, model.control_vertices, scan, FitOptions(), meter)).reference


@pytest.mark.parametrize("pulls", [(0.0, 0.0), (10.0, 10.0), (10.0, 0.0)])
def test_the_pull_of_the_scan_is_found_on_each_side(model, corners, pulls):
    subdivision = model.subdivision(2)
    scan = subdivision.matrix @ corners.pulled(model.control_vertices, *pulls)
    np.testing.assert_array_equal(
        start_on(model, (scan, subdivision.faces)), corners.pulled(model.control_vertices, *pulls)
    )


def test_a_spent_budget_leaves_the_mouth_as_it_is(model):
    spent = start_on(model, model.surface(2), Budget(evaluations=1))
    np.testing.assert_array_equal(spent, model.control_vertices)


def test_a_small_gain_is_no_smile(model, corners):
    assert PULLS_MM[0] == 0
    kept = corners.chosen(model.control_vertices, [2.0, 1.9], [2.0, 1.0])
    np.testing.assert_array_equal(kept, corners.pulled(model.control_vertices, 0.0, PULLS_MM[1]))


def test_a_model_without_landmarks_has_no_corners(mask_model):
    assert MouthCorners.of(mask_model, mask_model.control_vertices) is None
