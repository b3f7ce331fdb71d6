"""The corners of the mouth are drawn back before the face bends."""

from dataclasses import replace
from sys import modules

import numpy as np
import pytest
from helpers.measures import row_lengths

from scan2albedo.core import Budget, Meter
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.fitting import fit, mouth_opening as mouth
from scan2albedo.fitting.mouth_opening import CORNERS, corner_moves
from scan2albedo.fitting.options import FitOptions
from scan2albedo.fitting.samples import SurfaceSamples
from scan2albedo.fitting.scan_surface import scan_near_model
from scan2albedo.fitting.stages import Deformation

RIGHT, LEFT = CORNERS


def smiling(model, right_mm, left_mm):
    return model.control_vertices + corner_moves(model, model.control_vertices) @ (right_mm, left_mm)


def scan_of(model, control_points):
    subdivision = model.subdivision(2)
    vertices = subdivision.matrix @ control_points
    box = vertices.min(0) - 9, vertices.max(0) + 9
    return scan_near_model(vertices, subdivision.faces, np.eye(4), *box, 0.8)


def pulls_of(model, scan):
    """What `corners_pulled` finds, each trial's coarse fit being the pulled model itself."""
    deformation = Deformation(model, model.control_vertices, scan, FitOptions(), Meter("fit", "mm"))
    return mouth.corners_pulled(deformation).corners_mm


@pytest.fixture
def no_fits(monkeypatch):
    monkeypatch.setattr(mouth, "coarsely_fitted", lambda deformation, reference: reference)


def test_a_pull_moves_the_corners_back_and_up_and_keeps_the_rest(model):
    moved = model.landmarks_of(smiling(model, 10, 10)) - model.landmarks
    for corner, side in ((RIGHT, -1), (LEFT, 1)):
        assert np.linalg.norm(moved[corner]) == pytest.approx(10, abs=1.5)
        assert (moved[corner] * [side, 1, -1] > 3).all()
    upper_face_and_ears = [0, 1, 2, 14, 15, 16, *range(17, 28), *range(36, 48)]
    assert row_lengths(moved[upper_face_and_ears]).max() < 0.2
    assert row_lengths(moved[[51, 57, 62, 66]]).max() < 2
    one_side = model.landmarks_of(smiling(model, 10, 0)) - model.landmarks
    np.testing.assert_allclose(one_side[RIGHT], moved[RIGHT], atol=0.5)
    assert np.linalg.norm(one_side[LEFT]) < 0.5


@pytest.mark.parametrize("pulled", [(0.0, 0.0), (10.0, 10.0), (0.0, 15.0), (10.0, 0.0), (-14.0, -14.0)])
def test_each_side_is_found_for_itself(model, no_fits, pulled):
    assert pulls_of(model, scan_of(model, smiling(model, *pulled))) == pulled


def test_a_side_without_scan_stays(model, no_fits):
    scan = scan_of(model, smiling(model, 15, 15))
    middle = model.landmarks[list(CORNERS)].mean(0)
    half = replace(scan, vertices=np.where(scan.vertices[:, :1] < middle[0], scan.vertices, 1e3))
    samples = SurfaceSamples.of(model, model.control_vertices, 1)
    assert np.isnan(mouth.mouth_distances(samples, half, middle, model.control_vertices)[1])
    assert pulls_of(model, half) == (15.0, 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["generic_mouthSmile_L_mouthSmile_R", "person2_mouthSmile_L_mouthSmile_R"])
def test_a_smile_is_followed_only_with_the_search(ict, shape, monkeypatch):
    scan, pose, errors_mm = ict.scan_of(shape, ict.model)
    found = errors_mm(fit(scan, ict.model, pose))[list(CORNERS)].mean()
    for stage in ("mouth_opened", "corners_pulled"):
        monkeypatch.setattr(modules["scan2albedo.fitting.fit"], stage, lambda deformation, *_: deformation)
    assert found < min(3.5, 0.6 * errors_mm(fit(scan, ict.model, pose))[list(CORNERS)].mean())


def test_a_budget_that_ends_in_the_search_leaves_the_mouth_as_it_is(model):
    subdivision = model.subdivision(2)
    scan = RawScan(subdivision.matrix @ smiling(model, 15, 15), subdivision.faces)
    for evaluations in (5, 20, 40):
        fitted = fit(scan, model, np.eye(4), Budget(evaluations=evaluations))
        assert not fitted.converged
        assert fitted.iterations <= evaluations
        assert np.isfinite(fitted.vertices).all()
