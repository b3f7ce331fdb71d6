from dataclasses import replace

import numpy as np
import pytest

from scan2albedo.core import Meter
from scan2albedo.core.landmarks import PlacedLandmarks
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.fitting import FitOptions, fit
from scan2albedo.fitting.landmark_pull import LandmarkPull
from scan2albedo.fitting.mouth_opening import CHIN, MOVING, STILL, JawHinge, MouthSearch, mouth_opened
from scan2albedo.fitting.samples import SurfaceSamples
from scan2albedo.fitting.scan_surface import scan_near_model
from scan2albedo.fitting.stages import Deformation


def without_film(model, control_points):
    """The surface of a model as a scan that ends at the lips."""
    subdivision = model.subdivision(2)
    film = model.in_region("between_lips")[subdivision.parent]
    return subdivision.matrix @ control_points, subdivision.faces[~film]


def at_angle(model, angle_deg):
    """The model's control points with its jaw turned."""
    return JawHinge.of(model, model.control_vertices).opened(model.control_vertices, angle_deg)


def test_the_jaw_turns_and_the_upper_face_stays(ict):
    model = ict.model
    hinge = JawHinge.of(model, model.control_vertices)
    assert 0 <= hinge.weight.min() < hinge.weight.max() <= 1
    moved = model.landmarks_of(hinge.opened(model.control_vertices, 15)) - model.landmarks
    assert np.abs(moved[list(STILL)]).max() < 2
    reach = np.linalg.norm(model.landmarks[CHIN, 1:] - hinge.center[1:])
    assert np.linalg.norm(moved[CHIN]) == pytest.approx(2 * reach * np.sin(np.deg2rad(7.5)), rel=0.05)
    assert (moved[list(MOVING), 1] < -10).all()
    rest = model.control_vertices
    np.testing.assert_allclose(hinge.opened(rest, 0), rest, atol=1e-9)
    for angle in (0.0, 5.0, 20.0):
        assert hinge.angle_deg(rest, hinge.opened(rest, angle)) == pytest.approx(angle, abs=0.2)


def lip_gap(landmarks):
    return landmarks[[61, 62, 63], 1] - landmarks[[67, 66, 65], 1]


def search_on(model, vertices, faces):
    """The search for the jaw of a model at rest, on a scan that lies in its frame."""
    scan = scan_near_model(vertices, faces, np.eye(4), vertices.min(0), vertices.max(0))
    deformation = Deformation(model, model.control_vertices, scan, FitOptions(), Meter("fit", "mm"))
    return MouthSearch(deformation, JawHinge.of(model, model.control_vertices))


@pytest.mark.parametrize("angle", [0.0, 12.0, 20.0])
def test_the_search_finds_the_angle_of_an_opened_model(ict, angle):
    search = search_on(ict.model, *without_film(ict.model, at_angle(ict.model, angle)))
    assert search.tried() == angle
    assert mouth_opened(search.deformation).jaw_deg == angle


@pytest.mark.parametrize(("shut_mm", "found"), [(3.0, 16.0), (1.0, 0.0)])
def test_a_far_jaw_is_also_turned_by_two_steps(model, monkeypatch, shut_mm, found):
    costs = {0.0: shut_mm, 8.0: shut_mm + 0.2, 12.0: 0.9, 16.0: 0.5, 20.0: 0.9, 24.0: 2.0}
    monkeypatch.setattr("scan2albedo.fitting.mouth_opening.coarsely_fitted", lambda _, start: start)
    monkeypatch.setattr(MouthSearch, "opened", lambda _, angle: angle)
    monkeypatch.setattr(MouthSearch, "cost", lambda _, angle: costs[angle])
    monkeypatch.setattr(MouthSearch, "gap", lambda _, angle: 1.0)
    assert search_on(model, *without_film(model, model.control_vertices)).tried() == found


def test_a_mouth_is_open_where_the_scan_has_a_gap_alone(model):
    opened = at_angle(model, 16.0)
    with_gap = search_on(model, *without_film(model, opened))
    covered = search_on(model, model.subdivision(2).matrix @ opened, model.subdivision(2).faces)
    assert with_gap.gap(opened) > 0.9
    assert covered.gap(opened) < 0.1
    assert with_gap.tried() == 16.0
    assert covered.tried() == 0.0


def test_the_lower_lip_shows_the_angle_and_the_upper_lip_does_not(model):
    opened = at_angle(model, 12.0)
    scan = without_film(model, opened)
    placed = PlacedLandmarks.of({number: model.landmarks_of(opened)[number] for number in (30, 51, 57)})
    pull = LandmarkPull.of(model, placed, np.eye(4))
    deformation = search_on(model, *scan).deformation
    assert mouth_opened(deformation, pull).jaw_deg == 12.0
    assert deformation.meter.evaluations == 0  # no trial
    unsure = replace(pull, sigma_mm=np.full(len(pull.numbers), 4.0))
    for undecided in (pull.only(pull.numbers != 57), unsure):
        before = deformation.meter.evaluations
        mouth_opened(deformation, undecided)
        assert deformation.meter.evaluations > before
    metrics = fit(RawScan(*scan, landmarks=placed), model, np.eye(4)).metrics
    assert metrics["jaw_deg"] == 12.0
    assert metrics["corner_right_mm"] == metrics["corner_left_mm"] == 0


def test_landmarks_open_no_mouth_away_from_the_scan(model):
    placed = PlacedLandmarks.of({57: model.landmarks[57] - (0, 20, 0)})
    pull = LandmarkPull.of(model, placed, np.eye(4))
    assert mouth_opened(search_on(model, *model.surface(2)).deformation, pull).jaw_deg == 0.0


@pytest.mark.parametrize("angle", [8.0, 16.0])
def test_the_default_model_opens_along_its_film(model, angle):
    opened = model.landmarks_of(at_angle(model, angle))
    assert (lip_gap(model.landmarks) < 1.5).all()
    assert (lip_gap(opened) > 0.8 * angle).all()
    assert np.abs(opened - model.landmarks)[list(STILL)].max() < 1.5


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shape", "ceiling_mm"),
    [("generic_jawOpen0.7", 4.5), ("person3_browInnerUp_L_browInnerUp_R_jawOpen0.5", 5.3)],
)
def test_the_default_model_follows_open_mouths(ict, model, shape, ceiling_mm):
    scan, pose, errors_mm = ict.scan_of(shape, model, 0, slice(17, 48))
    fitted = fit(scan, model, pose)
    assert errors_mm(fitted)[48:].mean() < ceiling_mm
    assert fitted.metrics["flipped_faces"] == 0


@pytest.mark.slow
@pytest.mark.parametrize("person", ["generic_neutral", "person1", "person2", "person3", "person4"])
def test_shut_mouths_stay_shut_and_nobody_smiles_who_does_not(ict, model, person):
    for template in (ict.model, model):
        scan, pose, _ = ict.scan_of(person, template)
        fitted = fit(scan, template, pose)
        assert lip_gap(fitted.landmarks).max() < 3.0
        assert fitted.metrics["corner_right_mm"] == fitted.metrics["corner_left_mm"] == 0


def test_nothing_pulls_at_the_film_between_the_lips(model):
    samples = SurfaceSamples.of(model, model.control_vertices, 1)
    film = model.in_region("between_lips")[samples.parent]
    inside = np.setdiff1d(samples.faces[film], samples.faces[~film])
    assert len(inside) > 0
    assert (samples.area[inside] == 0).all()
    assert (samples.area >= 0).all()
