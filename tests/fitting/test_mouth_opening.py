import numpy as np
import pytest

from scan2albedo.fitting import FitOptions, fit
from scan2albedo.fitting.mouth_opening import CHIN, MOVING, STILL, JawHinge, MouthSearch
from scan2albedo.fitting.scan_surface import scan_near_model
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.io.raw_scan import RawScan


def opened_scan(model, angle_deg):
    """The model itself with its jaw turned, as a scan (faces over the mouth left out)."""
    control = JawHinge.of(model, model.control_vertices).opened(model.control_vertices, angle_deg)
    subdivision = model.subdivision(2)
    seen = model.region[subdivision.parent] != model.regions["filled"].index
    return subdivision.matrix @ control, subdivision.faces[seen]


def test_the_jaw_turns_and_the_upper_face_stays(ict):
    model = ict.model
    hinge = JawHinge.of(model, model.control_vertices)
    assert hinge.weight.min() >= 0
    assert hinge.weight.max() <= 1
    moved = model.landmarks_of(hinge.opened(model.control_vertices, 15)) - model.landmarks
    assert np.abs(moved[list(STILL)]).max() < 2
    reach = np.linalg.norm(model.landmarks[CHIN, 1:] - hinge.center[1:])
    assert np.linalg.norm(moved[CHIN]) == pytest.approx(2 * reach * np.sin(np.deg2rad(7.5)), rel=0.05)
    assert (moved[list(MOVING), 1] < -10).all()
    np.testing.assert_allclose(hinge.opened(model.control_vertices, 0), model.control_vertices, atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 12.0, 20.0])
def test_the_search_finds_the_angle_of_an_opened_model(ict, angle):
    model = ict.model
    vertices, faces = opened_scan(model, angle)
    scan = scan_near_model(vertices, faces, np.eye(4), vertices.min(0), vertices.max(0))
    search = MouthSearch.of(model, model.control_vertices, scan, 1)
    expected = JawHinge.of(model, model.control_vertices).opened(model.control_vertices, angle)
    assert (len(search.candidates) == 1) == (angle == 0)
    gap = min(np.abs(candidate - expected).max() for candidate in search.candidates)
    assert gap < 1e-6


def test_an_open_mouth_is_followed_only_with_the_search(ict):
    model = ict.model
    vertices, faces = opened_scan(model, 16.0)

    def chin_error(open_mouth):
        options = FitOptions(open_mouth=open_mouth, levels=(0, 0, 1), result_levels=1)
        fitted = fit(RawScan(vertices, faces), model, np.eye(4), options=options)
        truth = JawHinge.of(model, model.control_vertices).opened(model.control_vertices, 16.0)
        goal = transform_points(fitted.model_from_scan, model.landmarks_of(truth))
        return np.linalg.norm(fitted.landmarks - goal, axis=1)[list(MOVING)].mean()

    assert chin_error(True) < 2.0
    assert chin_error(False) > 6.0


def test_models_without_landmarks_stay_as_they_are(mask_model, mask_scan):
    assert JawHinge.of(mask_model, mask_model.control_vertices) is None
