"""Landmarks that a network finds in pictures of a scan come back to the scan, and the fit uses them."""

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from helpers.meshes import ball

from scan2albedo import process
from scan2albedo.batch import run_batch
from scan2albedo.errors import MissingDependencyError
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.pipeline import detected_landmarks as detected
from scan2albedo.pipeline.options import ProcessOptions
from scan2albedo.synthetic import raw_scan


class Network:
    """Sees the true landmarks in each of the views, in order; `aside` pixels too far right in the first."""

    def __init__(self, truth, aside=0.0):
        self.pictures, self.truth, self.aside = [], truth, aside

    def __call__(self, picture):
        angles = detected._VIEWS_DEG[len(self.pictures)]
        self.pictures.append(picture)
        view = detected.View((0, 0, 0), detected._HALF_WIDTH_MM, *angles)
        points = np.zeros((478, 2))
        for number, point in detected._POINTS.items():
            points[point] = view.pixels(self.truth.landmarks[number : number + 1], detected._SIZE)[0]
        return points + [self.aside if len(self.pictures) == 1 else 0.0, 0.0]


@pytest.fixture
def network(monkeypatch, coarse_scan):
    """Puts a network, or one that sees the truth, in place of MediaPipe's; returns it."""

    def install(seen=None):
        seen = seen or Network(coarse_scan[1])
        monkeypatch.setattr(detected, "_detector", lambda: nullcontext(seen))
        monkeypatch.setattr(detected, "require_detector", lambda: None)
        monkeypatch.setattr("scan2albedo.pipeline.stages.require_detector", lambda: None)
        return seen

    return install


def errors_mm(found, truth):
    return np.linalg.norm(transform_points(truth.model_from_scan, found.points) - truth.landmarks, axis=1)


@pytest.mark.slow
def test_a_process_hands_them_to_the_fit_or_goes_on_without(coarse_scan, network):
    scan, _ = coarse_scan
    network()
    asked = {"landmarks": "auto", "size": 64, "quality": "draft", "skip": ["albedo"]}
    result = process(scan, **asked)
    assert result.scan.landmarks.placed.sum() > 30
    assert result.options["landmarks"] == "auto"
    network(lambda picture: None)
    without = process(scan, **asked)
    assert any("MediaPipe finds no face" in note for note in without.notes)
    assert without.scan.landmarks is None


def test_points_of_pictures_come_back_to_the_scan(coarse_scan, network):
    scan, truth = coarse_scan
    seen = network(Network(truth, aside=20.0))
    found = detected.detected_landmarks(scan, truth.model_from_scan)
    assert found.placed.sum() > 30
    assert set(np.flatnonzero(found.placed)) <= set(detected._POINTS)
    # A network's point of which one view errs is still right.
    assert np.nanmedian(errors_mm(found, truth)) < 1.0
    assert np.nanmax(errors_mm(found, truth)) < 6.0
    assert len(seen.pictures) == len(detected._VIEWS_DEG)
    assert all(picture.dtype == np.uint8 and picture.std() > 10 for picture in seen.pictures)


def test_grey_shapes_are_believed_less(coarse_scan, network):
    scan, truth = coarse_scan
    network()
    colored = detected.detected_landmarks(scan, truth.model_from_scan)
    network()
    plain = detected.detected_landmarks(replace(scan, uv=None, texture_linear=None), truth.model_from_scan)
    both = colored.placed & plain.placed
    assert (plain.sigma_mm[both] > 1.5 * colored.sigma_mm[both]).all()


def test_landmarks_placed_by_hand_win(coarse_scan, network):
    scan, truth = coarse_scan
    by_hand = np.full((68, 3), np.nan)
    by_hand[[8, 36]] = [[1.0, 2, 3], [4, 5, 6]]
    placed = replace(scan, landmarks=by_hand)
    network()
    both = detected.with_detected(placed, truth.model_from_scan)[0].landmarks
    np.testing.assert_array_equal(both.points[[8, 36]], by_hand[[8, 36]])
    assert both.placed.sum() > 30
    network(lambda picture: None)
    alone, (doubt,) = detected.with_detected(placed, truth.model_from_scan)
    assert alone.landmarks.placed.sum() == 2
    assert (doubt.level, doubt.reason[:22]) == ("doubt", "MediaPipe finds no fac")


def test_a_small_budget_leaves_the_network_out(coarse_scan, network):
    scan, truth = coarse_scan
    seen = network()
    alone, (doubt,) = detected.with_detected(scan, truth.model_from_scan, 0.5)
    assert alone.landmarks is None
    assert "too little of the budget" in doubt.reason
    assert not seen.pictures


def test_where_colours_show_no_face_grey_is_tried(coarse_scan, network):
    scan, truth = coarse_scan
    seen = Network(truth)
    network(lambda picture: seen(picture) if np.ptp(picture, axis=2).max() == 0 else None)
    found = detected.detected_landmarks(scan, truth.model_from_scan)
    assert len(seen.pictures) == len(detected._VIEWS_DEG)
    assert found.placed.sum() > 30


def test_what_is_missing_is_named_before_anything_is_done(monkeypatch, coarse_scan, tmp_path):
    monkeypatch.setattr(detected, "find_spec", lambda name: None)
    (tmp_path / "list.csv").write_text("scan,landmarks\na.ply,\nb.ply,Auto\n")
    for call in (
        lambda: process(coarse_scan[0], landmarks="auto"),
        lambda: run_batch(tmp_path / "list.csv", tmp_path / "out"),
    ):
        with pytest.raises(MissingDependencyError, match=r"pip install 'scan2albedo\[landmarks\]'"):
            call()
    assert not (tmp_path / "out").exists()
    # Without a model the network is not asked for.
    result = process(ball(), landmarks="Auto", model="none", size=32, skip=["albedo"])
    assert "landmarks are not used: without a model nothing is fitted to them" in result.notes


def test_auto_is_a_word_in_any_case_and_nothing_is_no_folder():
    assert ProcessOptions(landmarks="AUTo ") == ProcessOptions(landmarks="auto")
    assert ProcessOptions(landmarks="./auto").landmarks == "./auto"
    with pytest.raises(ValueError, match="landmarks is empty"):
        ProcessOptions(landmarks=" ")


def test_the_network_itself():
    pytest.importorskip("mediapipe", reason="the extra [landmarks] is not installed")
    scan, truth = raw_scan(41)
    found = detected.detected_landmarks(scan, truth.model_from_scan)
    assert np.nanmedian(errors_mm(found, truth)[48:60]) < 6.0  # of the lips
